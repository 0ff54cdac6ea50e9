"""Rotations in NumPy, for everything that runs without torch: runtime, rendering, import.

Convention
    Quaternions are (..., 4), scalar first (wxyz), and rotate actively; ``q`` and ``-q`` are one rotation. Leading
    dimensions broadcast. Results are float64. ``mambaloc.geometry`` is the differentiable counterpart in torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_HAMILTON = np.array(  # what a_i b_j adds to component k of a product
    [
        [[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, -1]],
        [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
        [[0, 0, 1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
        [[0, 0, 0, 1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]],
    ]
)
_SIGN_WEIGHTS = np.array([8.0, 4.0, 2.0, 1.0])  # each outvotes all that follow it
_TINY = np.finfo(np.float64).tiny


def canonical(quaternion: ArrayLike) -> Floats:
    """Choose between ``q`` and ``-q``: unit length, and the first non-zero of w, x, y, z positive.

    Shape:
        (..., 4), of any length but 0 -> (..., 4).
    """
    q = np.asarray(quaternion, np.float64)
    scaled = q / np.abs(q).max(axis=-1, keepdims=True)  # squares stay in range, and digits those of mambaloc.geometry
    return scaled / np.copysign(_length(scaled), (np.sign(q) @ _SIGN_WEIGHTS)[..., None])


def conjugate(quaternion: ArrayLike) -> Floats:
    """Negate the vector part: the inverse rotation; (..., 4) -> (..., 4)."""
    return np.asarray(quaternion, np.float64) * (1.0, -1.0, -1.0, -1.0)


def multiply(a: ArrayLike, b: ArrayLike) -> Floats:
    """Hamilton product ``a b``: rotate by ``b``, then by ``a``.

    Shape:
        (..., 4), (..., 4) -> (..., 4). Lengths multiply; signs are kept as they fall.
    """
    return np.einsum("kij,...i,...j->...k", _HAMILTON, np.asarray(a, np.float64), np.asarray(b, np.float64))


def matrix_from_quaternion(quaternion: ArrayLike) -> Floats:
    """Rotation matrices of quaternions of any length but 0; (..., 4) -> (..., 3, 3)."""
    q = np.asarray(quaternion, np.float64)
    w, x, y, z = np.moveaxis(q / _length(q), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def quaternion_from_matrix(matrix: ArrayLike) -> Floats:
    """Canonical quaternions of rotation matrices, well conditioned at every angle (Shepperd 1978).

    Shape:
        (..., 3, 3) -> (..., 4).

    The matrix's entries give all of ``4 q q^T`` linearly. Any of its rows is ``q`` up to scale; the one with the
    largest diagonal is taken, which is at least 1, so nothing is divided by a small number.
    """
    m = np.moveaxis(np.asarray(matrix, np.float64), (-2, -1), (0, 1))
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] + m[1, 2]
    outer = np.array(
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], wx, wy, wz],
            [wx, 1 + m[0, 0] - m[1, 1] - m[2, 2], xy, xz],
            [wy, xy, 1 - m[0, 0] + m[1, 1] - m[2, 2], yz],
            [wz, xz, yz, 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    rows = np.moveaxis(outer, (0, 1), (-2, -1))
    largest = np.diagonal(rows, axis1=-2, axis2=-1).argmax(axis=-1)[..., None, None]
    return canonical(np.take_along_axis(rows, largest, axis=-2)[..., 0, :])


def quaternion_from_rotation_vector(rotation_rad: ArrayLike) -> Floats:
    """Exponential map: the quaternion of an axis times an angle; (..., 3), radians -> (..., 4)."""
    vector = np.asarray(rotation_rad, np.float64)
    half_rad = _length(vector) / 2
    return np.concatenate((np.cos(half_rad), np.sin(half_rad) / np.maximum(2 * half_rad, _TINY) * vector), axis=-1)


def rotation_vector_from_quaternion(quaternion: ArrayLike) -> Floats:
    """Logarithm map: the shortest rotation vector of unit quaternions of either sign; (..., 4) -> (..., 3), radians."""
    q = np.asarray(quaternion, np.float64)
    sine = _length(q[..., 1:])
    angle_rad = np.copysign(2 * np.arctan2(sine, np.abs(q[..., :1])), q[..., :1])
    return angle_rad / np.maximum(sine, _TINY) * q[..., 1:]


def rotation_vector_between(a: ArrayLike, b: ArrayLike) -> Floats:
    """Rotation vector, in ``a``'s own axes, that turns ``a`` into ``b``; (..., 4), (..., 4) -> (..., 3), radians."""
    return rotation_vector_from_quaternion(multiply(conjugate(a), b))


def rotation_error_deg(a: ArrayLike, b: ArrayLike) -> Floats:
    """Angle of the rotation between unit quaternions of either sign, in 0..180 degrees; (..., 4), (..., 4) -> (...).

    From chord lengths: an arccos loses half its digits near 0.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return degrees_of_chords(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


def degrees_of_chords(minus: Floats, plus: Floats) -> Floats:
    """Angle of the rotation between unit quaternions, 0..180 degrees, of the lengths of their difference and sum."""
    return np.degrees(4 * np.arctan2(np.minimum(minus, plus), np.maximum(minus, plus)))


def rigid_transforms(rotation: ArrayLike, position: ArrayLike) -> Floats:
    """Homogeneous matrices.

    Shape:
        (N, 3, 3), (N, 3) -> (N, 4, 4).
    """
    matrices = np.tile(np.eye(4), (len(np.asarray(position)), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = rotation, position
    return matrices


def is_rotation(matrix: ArrayLike, tolerance: float = 1e-3) -> NDArray[Any]:
    """Whether matrices are finite, orthonormal and right-handed; (..., 3, 3) -> (...), bool.

    ``tolerance`` bounds each entry of ``|R R^T - I|``; the sign of the determinant then decides.
    """
    m = np.asarray(matrix, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(m @ np.swapaxes(m, -1, -2) - np.eye(3)).max(axis=(-2, -1))
        handedness = (np.cross(m[..., 0, :], m[..., 1, :]) * m[..., 2, :]).sum(axis=-1)
    return (off <= tolerance) & (handedness > 0)  # NaN compares false


def _length(vector: Floats) -> Floats:
    """Norms (..., 1) of vectors (..., N); for a single one in half the time of ``np.linalg.norm``."""
    return np.sqrt((vector * vector).sum(axis=-1, keepdims=True))
