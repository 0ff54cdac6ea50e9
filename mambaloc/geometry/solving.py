"""Poses in closed form from what rays of an image see: batched, differentiable, plain products that ONNX has."""

from __future__ import annotations

import torch
from torch import Tensor

from mambaloc.geometry.rotations import canonical

_SQUARINGS = 12


def align_directions(camera: Tensor, world: Tensor, weights: Tensor) -> Tensor:
    """Rotation ``world_from_cam`` that turns directions into others best: weighted Procrustes, or Wahba's problem.

    It maximises ``sum w_i world_i . R camera_i``. Davenport's symmetric 4x4 matrix has the quaternion as the
    eigenvector of its largest eigenvalue, which repeated squaring finds without a decomposition. A reflection is never
    returned. Where directions determine no rotation (all parallel), it is one of the best.

    Shape:
        (B, N, 3) unit, (B, N, 3) unit, (B, N) not negative, of sum 1 -> (B, 4), canonical.
    """
    # No matmul here: TF32 and autocast, which training may switch on, would round it to three digits.
    moments = ((weights[..., None] * world)[..., :, None] * camera[..., None, :]).sum(dim=1)
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = (row.unbind(-1) for row in moments.unbind(-2))
    entries = [
        [m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01],
        [m21 - m12, m00 - m11 - m22, m01 + m10, m02 + m20],
        [m02 - m20, m01 + m10, m11 - m00 - m22, m12 + m21],
        [m10 - m01, m02 + m20, m12 + m21, m22 - m00 - m11],
    ]
    davenport = torch.stack([torch.stack(row, dim=-1) for row in entries], dim=-2)
    power = davenport + torch.eye(4, dtype=davenport.dtype, device=davenport.device)  # eigenvalues in 0..2
    for _ in range(_SQUARINGS):
        power = power / power.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        power = (power[..., :, :, None] * power[..., None, :, :]).sum(dim=-2)
    largest = power.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)[..., None, None]
    return canonical(power.gather(-2, largest.expand_as(power[..., :1, :])).squeeze(-2))


def intersect_rays(directions: Tensor, points: Tensor, weights: Tensor, prior: Tensor, prior_weight: float) -> Tensor:
    """Centre of a camera that sees points in given directions: least squares of the points' distances from its rays.

    It minimises ``sum w_i |(I - d_i d_i^T) (X_i - t)|^2 + prior_weight |t - prior|^2``.

    Shape:
        directions (B, N, 3) unit, in the world; points (B, N, 3); weights (B, N); prior (B, 3) -> (B, 3).
    """
    # Along a ray nothing is measured: a projection onto d is taken off every sum.
    along = (directions * points).sum(dim=-1, keepdim=True)
    outer = ((weights[..., None] * directions)[..., :, None] * directions[..., None, :]).sum(dim=1)
    identity = torch.eye(3, dtype=points.dtype, device=points.device)
    normal = (weights.sum(dim=1) + prior_weight)[..., None, None] * identity - outer
    moment = (weights[..., None] * (points - along * directions)).sum(dim=1) + prior_weight * prior
    first, second, third = normal.unbind(-2)  # of a symmetric matrix rows are columns: Cramer's rule
    cofactors = (torch.linalg.cross(second, third), torch.linalg.cross(third, first), torch.linalg.cross(first, second))
    determinant = (first * cofactors[0]).sum(dim=-1, keepdim=True)
    solved = sum(c * m for c, m in zip(cofactors, moment.split(1, dim=-1), strict=True))
    return solved / determinant
