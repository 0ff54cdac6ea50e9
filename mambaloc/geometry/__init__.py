"""Rotations, poses and cameras: torch only, conventions as in ``mambaloc.types``."""

from mambaloc.geometry.cameras import cropped_intrinsics, grid_rays, project, project_from_world, resized_intrinsics
from mambaloc.geometry.homographies import rotation_homography, warped
from mambaloc.geometry.poses import (
    Pose,
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
    log_from_quaternion,
    matrix_from_quaternion,
    multiply,
    normalize,
    quaternion_from_log,
    quaternion_from_matrix,
    rotate,
    rotation_error_deg,
)
from mambaloc.geometry.solving import align_directions, intersect_rays

__all__ = [
    "Pose",
    "align_directions",
    "canonical",
    "compose",
    "conjugate",
    "cropped_intrinsics",
    "grid_rays",
    "intersect_rays",
    "inverse",
    "is_rotation",
    "log_from_quaternion",
    "matrix_from_pose",
    "matrix_from_quaternion",
    "multiply",
    "normalize",
    "pose_from_matrix",
    "position_error_m",
    "project",
    "project_from_world",
    "quaternion_from_log",
    "quaternion_from_matrix",
    "resized_intrinsics",
    "rotate",
    "rotation_error_deg",
    "rotation_homography",
    "transform",
    "warped",
]
