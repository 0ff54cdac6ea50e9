"""What a camera sees that is turned about its centre, and perhaps zoomed: exact, at whatever depth things are.

A pixel ``x'`` of the turned camera looks along ``K'^-1 x'``. The other camera sees that ray at ``K R K'^-1 x'``, where
``R`` is the rotation ``cam_from_turned`` (Hartley and Zisserman 2004, section 8.4).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

_NEAR = 0.01  # least depth of a ray, along the axis of the camera that is looked up


def rotation_homography(intrinsics: Tensor, cam_from_turned: Tensor, turned_intrinsics: Tensor) -> Tensor:
    """Where a camera sees the pixels of another one, turned about the same centre.

    Args:
        intrinsics: of the camera.
        cam_from_turned: rotation matrices.
        turned_intrinsics: of the turned camera; without skew.

    Shape:
        (B, 3, 3) each -> (B, 3, 3), from homogeneous pixels ``(x, y, 1)`` of the turned camera.
    """
    inverse_focal = 1 / torch.stack((turned_intrinsics[:, 0, 0], turned_intrinsics[:, 1, 1]), dim=-1)
    # No matmul: TF32 would round pixels to tenths.
    turned = (intrinsics[:, :, :, None] * cam_from_turned[:, None]).sum(dim=2)
    columns = turned[:, :, :2] * inverse_focal[:, None]
    return torch.cat((columns, turned[:, :, 2:] - (columns * turned_intrinsics[:, None, :2, 2]).sum(-1, True)), dim=-1)


def warped(image: Tensor, homography: Tensor, size: tuple[int, int]) -> Tensor:
    """Look each pixel up in an image, bilinearly; black where it is outside. Nothing waits for the device.

    Args:
        image: floating point.
        homography: from pixels of the result to pixels of the image.
        size: height and width of the result.

    Shape:
        (B, C, H, W), (B, 3, 3) -> (B, C, *size).
    """
    y, x = (torch.arange(length, device=image.device, dtype=image.dtype) for length in size)
    height, width = image.shape[-2:]
    sampled = homography.clone()  # to grid_sample's coordinates, in which the borders are at -1 and 1
    for row, length in enumerate((width, height)):
        sampled[:, row] = (2 * homography[:, row] + homography[:, 2]) / length - homography[:, 2]
    columns = sampled[..., None, None]
    homogeneous = columns[:, :, 0] * x + (columns[:, :, 1] * y[:, None] + columns[:, :, 2])  # (B, 3, *size)
    # A ray behind the camera is never near the opposite of its axis, so that it falls far outside of the image.
    grid = homogeneous[:, :2] / homogeneous[:, 2:].clamp_min(_NEAR)
    return F.grid_sample(image, grid.permute(0, 2, 3, 1), padding_mode="zeros", align_corners=False)
