"""Rigid transforms: ``Pose``, and functions over it, batched and differentiable.

Convention
    Names read ``a_from_c = a_from_b @ b_from_c``: inner names cancel. Leading dimensions broadcast, so N points under
    each of B poses are points (B, N, 3) and a pose of (B, 1, 3) and (B, 1, 4). Quaternions need not be exactly
    unit; those returned are canonical.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import deprecated

from mambaloc.geometry.rotations import (
    canonical,
    conjugate,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    rotate,
)


@dataclass(frozen=True)
class Pose:
    """Rigid transform ``a_from_b``; as a camera pose, ``world_from_cam``.

    Shape:
        ``position_m`` is (..., 3) in metres, ``quaternion`` is (..., 4), unit, wxyz.
    """

    position_m: Tensor
    quaternion: Tensor

    def __matmul__(self, b_from_c: Pose) -> Pose:
        """Chain two transforms: ``a_from_c = a_from_b @ b_from_c``."""
        return Pose(
            position_m=transform(self, b_from_c.position_m),
            quaternion=canonical(multiply(self.quaternion, b_from_c.quaternion)),
        )

    def inverse(self) -> Pose:
        """Turn ``a_from_b`` into ``b_from_a``."""
        b_from_a = canonical(conjugate(self.quaternion))
        return Pose(position_m=-rotate(b_from_a, self.position_m), quaternion=b_from_a)


def transform(a_from_b: Pose, points_b: Tensor) -> Tensor:
    """Carry points from frame b to frame a: ``p_a = R p_b + t``.

    Shape:
        points (..., 3) -> (..., 3), metres.
    """
    return rotate(a_from_b.quaternion, points_b) + a_from_b.position_m


def matrix_from_pose(pose: Pose) -> Tensor:
    """Write a transform as the homogeneous matrix ``[R t; 0 1]``.

    Shape:
        -> (..., 4, 4).
    """
    top = torch.cat([matrix_from_quaternion(pose.quaternion), pose.position_m[..., None]], dim=-1)
    bottom = torch.eye(4, dtype=top.dtype, device=top.device)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def pose_from_matrix(matrix: Tensor) -> Pose:
    """Read a transform from its homogeneous matrix; the last row is not looked at.

    Shape:
        (..., 4, 4), or (..., 3, 4) -> a pose of (..., 3) and (..., 4).

    The upper left 3x3 must be a rotation: ask ``is_rotation`` of matrices that come from a file.
    """
    return Pose(position_m=matrix[..., :3, 3], quaternion=quaternion_from_matrix(matrix[..., :3, :3]))


def position_error_m(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distance between positions, with zero gradient where they coincide.

    Shape:
        (..., 3), (..., 3) -> (...), metres.
    """
    return torch.linalg.vector_norm(a - b, dim=-1)


@deprecated("Write a_from_b @ b_from_c.")
def compose(a_from_b: Pose, b_from_c: Pose) -> Pose:
    """Chain two transforms into ``a_from_c``. Deprecated: removed in the next release."""
    return a_from_b @ b_from_c


@deprecated("Write a_from_b.inverse().")
def inverse(a_from_b: Pose) -> Pose:
    """Turn ``a_from_b`` into ``b_from_a``. Deprecated: removed in the next release."""
    return a_from_b.inverse()
