"""Pinhole cameras: projection, and intrinsics that follow a resize and a crop.

Convention
    Intrinsics are (..., 3, 3), ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``, in pixels; the centre of the top-left pixel
    is ``(0, 0)`` (OpenCV). Leading dimensions broadcast: N points seen by each of B cameras are (B, N, 3) and
    (B, 1, 3, 3).
"""

from __future__ import annotations

import torch
from torch import Tensor

from mambaloc.geometry.rotations import multiply


def project(points_cam_m: Tensor, intrinsics: Tensor) -> Tensor:
    """Pixels that points in camera coordinates fall on; meaningless unless their depth, ``z``, is positive.

    Shape:
        (..., 3), (..., 3, 3) -> (..., 2), pixels ``(x, y)``.
    """
    homogeneous = (intrinsics * points_cam_m[..., None, :]).sum(dim=-1)  # no matmul: TF32 and autocast would round it
    return homogeneous[..., :2] / homogeneous[..., 2:]


def turn_towards(x: Tensor, y: Tensor) -> Tensor:
    """Turn a camera, about its y and then its x axis, so that it looks along the ray ``(x, y, 1)``.

    Shape:
        (...), (...) -> (..., 4), ``cam_from_turned``.
    """
    yaw = torch.atan(x)
    pitch = -torch.atan(y * yaw.cos())
    zero = torch.zeros_like(yaw)
    about_y = torch.stack(((yaw / 2).cos(), zero, (yaw / 2).sin(), zero), dim=-1)
    about_x = torch.stack(((pitch / 2).cos(), (pitch / 2).sin(), zero, zero), dim=-1)
    return multiply(about_y, about_x)


def resized_intrinsics(intrinsics: Tensor, scale_x: float, scale_y: float) -> Tensor:
    """Intrinsics of an image resized by a factor an axis: pixel centres lie half a pixel inside of the border.

    Shape:
        (..., 3, 3) -> (..., 3, 3).
    """
    shift_x, shift_y = (scale_x - 1) / 2, (scale_y - 1) / 2
    resize = torch.tensor([[scale_x, 0, shift_x], [0, scale_y, shift_y], [0, 0, 1]])
    return resize.to(intrinsics) @ intrinsics


def cropped_intrinsics(intrinsics: Tensor, top: Tensor | int, left: Tensor | int) -> Tensor:
    """Intrinsics of a crop whose top-left pixel was at row ``top`` and column ``left``.

    Shape:
        (B, 3, 3), (B,) or a number each -> (B, 3, 3).
    """
    cropped = intrinsics.clone()
    cropped[..., 0, 2] -= torch.as_tensor(left).to(intrinsics)
    cropped[..., 1, 2] -= torch.as_tensor(top).to(intrinsics)
    return cropped
