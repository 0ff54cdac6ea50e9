"""Rotations and poses: torch only, conventions as in ``mambaloc.types``."""

from mambaloc.geometry.poses import (
    compose,
    inverse,
    matrix_from_pose,
    pose_from_matrix,
    position_error_m,
    transform,
)
from mambaloc.geometry.rotations import (
    canonical,
    conjugate,
    is_rotation,
    matrix_from_quaternion,
    multiply,
    normalize,
    quaternion_from_matrix,
    rotate,
    rotation_error_deg,
)

__all__ = [
    "canonical",
    "compose",
    "conjugate",
    "inverse",
    "is_rotation",
    "matrix_from_pose",
    "matrix_from_quaternion",
    "multiply",
    "normalize",
    "pose_from_matrix",
    "position_error_m",
    "quaternion_from_matrix",
    "rotate",
    "rotation_error_deg",
    "transform",
]
