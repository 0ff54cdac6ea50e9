"""Rotations as quaternions: batched, differentiable, free of data-dependent control flow.

Convention
    Quaternions are (..., 4), scalar first (wxyz), and rotate actively: ``p_a = rotate(a_from_b, p_b)``.
    ``q`` and ``-q`` are one rotation. Leading dimensions broadcast; dtype and device are the inputs'.
    What is not finite stays so: a NaN that a diverged network emits is never turned into a rotation.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def normalize(quaternion: Tensor) -> Tensor:
    """Scale to unit length; one shorter than the smallest normal number becomes the identity, with zero gradient.

    Shape:
        (..., 4) -> (..., 4).
    """
    # Division by the largest component keeps the squares in range. The result does not depend on that scale, so
    # leaving it out of the graph leaves every derivative exact.
    largest = quaternion.detach().abs().amax(dim=-1, keepdim=True)
    is_zero = largest < torch.finfo(quaternion.dtype).tiny
    identity = torch.eye(4, dtype=quaternion.dtype, device=quaternion.device)[0]
    scaled = torch.where(is_zero, identity, quaternion) / largest.masked_fill(is_zero, 1.0)
    return scaled / torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)


def canonical(quaternion: Tensor) -> Tensor:
    """Choose between ``q`` and ``-q``: unit length, and the first non-zero of w, x, y, z positive.

    Shape:
        (..., 4) -> (..., 4).
    """
    unit = normalize(quaternion)
    w, x, y, z = unit.detach().sign().unbind(-1)
    is_flipped = 8 * w + 4 * x + 2 * y + z < 0  # each weight outvotes all that follow it
    return torch.where(is_flipped[..., None], -unit, unit)


def conjugate(quaternion: Tensor) -> Tensor:
    """Negate the vector part: the inverse rotation.

    Shape:
        (..., 4) -> (..., 4).
    """
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], dim=-1)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product ``a b``: rotate by ``b``, then by ``a``.

    Shape:
        (..., 4), (..., 4) -> (..., 4).

    Convention:
        ``a_from_c = multiply(a_from_b, b_from_c)``. Lengths multiply; signs are kept as they fall.
    """
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by + ay * bw + az * bx - ax * bz,
            aw * bz + az * bw + ax * by - ay * bx,
        ],
        dim=-1,
    )


def rotate(quaternion: Tensor, point: Tensor) -> Tensor:
    """Rotate points by quaternions of any length.

    Shape:
        (..., 4), (..., 3) -> (..., 3).
    """
    # Here and below no matmul: TF32 and autocast, which training may switch on, would round it to three digits.
    return (matrix_from_quaternion(quaternion) * point[..., None, :]).sum(dim=-1)


def matrix_from_quaternion(quaternion: Tensor) -> Tensor:
    """Rotation matrices of quaternions of any length.

    Shape:
        (..., 4) -> (..., 3, 3), which multiplies column vectors from the left.
    """
    w, x, y, z = normalize(quaternion).unbind(-1)
    entries = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in entries], dim=-2)


def quaternion_from_matrix(matrix: Tensor) -> Tensor:
    """Canonical quaternions of rotation matrices, well conditioned at every angle (Shepperd 1978).

    Shape:
        (..., 3, 3) -> (..., 4).

    The matrix's entries give all of ``4 q q^T`` linearly. Any of its rows is ``q`` up to scale; the one with the
    largest diagonal is taken, at least 1 in any finite matrix, so nothing is divided by a small number.
    """
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = (row.unbind(-1) for row in matrix.unbind(-2))
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m10 + m01, m02 + m20, m21 + m12
    outer = [
        [1 + m00 + m11 + m22, wx, wy, wz],
        [wx, 1 + m00 - m11 - m22, xy, xz],
        [wy, xy, 1 - m00 + m11 - m22, yz],
        [wz, xz, yz, 1 - m00 - m11 + m22],
    ]
    rows = torch.stack([torch.stack(row, dim=-1) for row in outer], dim=-2)
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)[..., None, None]
    # take_along_dim would read better, but freezes the batch size in torch.export
    return canonical(rows.gather(-2, largest.expand_as(rows[..., :1, :])).squeeze(-2))


def log_from_quaternion(quaternion: Tensor) -> Tensor:
    """Logarithm of the canonical quaternion: the axis times half the angle (MapNet, Brahmbhatt et al. 2018).

    Shape:
        (..., 4), of any length and sign -> (..., 3), of norm 0..pi/2.
    """
    w, xyz = canonical(quaternion).split((1, 3), dim=-1)
    sine = torch.linalg.vector_norm(xyz, dim=-1, keepdim=True)
    is_small = sine < torch.finfo(sine.dtype).eps  # there angle / sine is 1 to the last digit
    return xyz * torch.where(is_small, 1.0, torch.atan2(sine, w) / sine.masked_fill(is_small, 1.0))


def quaternion_from_log(log_quaternion: Tensor) -> Tensor:
    """Exponential of an axis times half an angle: the inverse of :func:`log_from_quaternion` up to the sign.

    Shape:
        (..., 3), of any norm -> (..., 4), unit; ``w < 0`` where the norm passes pi/2.
    """
    half_angle = torch.linalg.vector_norm(log_quaternion, dim=-1, keepdim=True)
    return torch.cat((half_angle.cos(), torch.sinc(half_angle / math.pi) * log_quaternion), dim=-1)


def rotation_error_deg(a: Tensor, b: Tensor) -> Tensor:
    """Angle of the rotation between ``a`` and ``b``, quaternions of any length and sign, in 0..180 degrees.

    Shape:
        (..., 4), (..., 4) -> (...).

    Equal to ``2 acos(|<a, b>|)``, as ``2 atan2(|v|, |w|)`` of the relative quaternion: an acos loses half its digits
    near 0 and turns into NaN one rounding past 1. The gradient is zero where the error is zero.
    """
    relative = multiply(conjugate(normalize(a)), normalize(b))
    sine, cosine = torch.linalg.vector_norm(relative[..., 1:], dim=-1), relative[..., 0].abs()
    return torch.atan2(sine, cosine) * (360.0 / math.pi)


def is_rotation(matrix: Tensor, tolerance: float = 1e-3) -> Tensor:
    """Whether matrices are finite, orthonormal and right-handed.

    Shape:
        (..., 3, 3) -> (...), bool.

    ``tolerance`` bounds each entry of ``|R R^T - I|``; the determinant is then 1 or -1 nearly, and its sign decides.
    """
    gram = (matrix[..., :, None, :] * matrix[..., None, :, :]).sum(dim=-1)
    identity = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    is_orthonormal = ((gram - identity).abs() <= tolerance).flatten(-2).all(dim=-1)  # NaN compares false
    first, second, third = matrix.unbind(-2)
    return is_orthonormal & ((torch.linalg.cross(first, second) * third).sum(dim=-1) > 0)
