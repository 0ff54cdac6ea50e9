"""Pinhole cameras: projection, and intrinsics that follow a resize and a crop.

Convention
    Intrinsics are (..., 3, 3), ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``, in pixels; the centre of the top-left pixel
    is ``(0, 0)`` (OpenCV). Leading dimensions broadcast: N points seen by each of B cameras are (B, N, 3) and
    (B, 1, 3, 3).
"""

from __future__ import annotations

import torch
from torch import Tensor

from mambaloc.geometry.rotations import conjugate, normalize, rotate


def project(points_cam_m: Tensor, intrinsics: Tensor) -> Tensor:
    """Pixels that points in camera coordinates fall on; meaningless unless their depth, ``z``, is positive.

    Shape:
        (..., 3), (..., 3, 3) -> (..., 2), pixels ``(x, y)``.
    """
    homogeneous = (intrinsics * points_cam_m[..., None, :]).sum(dim=-1)  # no matmul: TF32 and autocast would round it
    return homogeneous[..., :2] / homogeneous[..., 2:]


def project_from_world(
    points_m: Tensor, position_m: Tensor, quaternion: Tensor, intrinsics: Tensor, near_m: float
) -> tuple[Tensor, Tensor]:
    """Pixels that world points fall on, and whether each lies farther than ``near_m`` in front of the camera.

    A nearer point is projected as if it lay at that depth, so that no gradient is infinite.

    Shape:
        (B, P, 3), (B, 3), (B, 4) ``world_from_cam``, (B, 3, 3) -> (B, P, 2) ``(x, y)``, (B, P) bool.
    """
    cam_from_world = conjugate(normalize(quaternion))[:, None]
    points_cam_m = rotate(cam_from_world, points_m - position_m[:, None])
    depth_m = points_cam_m[..., 2:]
    at_least_near_m = torch.cat((points_cam_m[..., :2], depth_m.clamp_min(near_m)), dim=-1)
    return project(at_least_near_m, intrinsics[:, None]), depth_m[..., 0] > near_m


def resized_intrinsics(intrinsics: Tensor, scale_x: Tensor | float, scale_y: Tensor | float) -> Tensor:
    """Intrinsics of an image resized by a factor an axis: pixel centres lie half a pixel inside of the border.

    Shape:
        (..., 3, 3), (...) or a number each -> (..., 3, 3).
    """
    resized = intrinsics.clone()
    for axis, factor in enumerate((scale_x, scale_y)):
        scale = torch.as_tensor(factor).to(intrinsics)
        resized[..., axis, :] *= scale[..., None]
        resized[..., axis, 2] += (scale - 1) / 2
    return resized


def cropped_intrinsics(intrinsics: Tensor, top: Tensor | int, left: Tensor | int) -> Tensor:
    """Intrinsics of a crop whose top-left pixel was at row ``top`` and column ``left``.

    Shape:
        (B, 3, 3), (B,) or a number each -> (B, 3, 3).
    """
    cropped = intrinsics.clone()
    cropped[..., 0, 2] -= left
    cropped[..., 1, 2] -= top
    return cropped


def grid_rays(intrinsics: Tensor, image_size: tuple[int, int], grid: tuple[int, int]) -> Tensor:
    """Directions in which a camera sees the centres of a grid's cells, row after row.

    Args:
        intrinsics: (B, 3, 3), in pixels of the image.
        image_size: its height and width.
        grid: rows and columns, which divide the image evenly.

    Returns:
        (B, rows * columns, 3), unit, in camera coordinates.
    """
    y_px, x_px = (
        (torch.arange(cells, dtype=intrinsics.dtype, device=intrinsics.device) + 0.5) * (side / cells) - 0.5
        for side, cells in zip(image_size, grid, strict=True)
    )
    x_N, y_N = x_px.repeat(grid[0]), y_px.repeat_interleave(grid[1])
    x = (x_N - intrinsics[:, 0, 2, None]) / intrinsics[:, 0, 0, None]
    y = (y_N - intrinsics[:, 1, 2, None]) / intrinsics[:, 1, 1, None]
    rays = torch.stack((x, y, torch.ones_like(x)), dim=-1)
    return rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
