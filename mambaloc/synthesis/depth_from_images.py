"""Frames with depth, from posed images without any."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.memory import release_pages
from mambaloc.runtime.maps.viewpoints import farthest_points
from mambaloc.synthesis.consistency import confirmed
from mambaloc.synthesis.plane_sweep import PlaneSweep, SweepSettings
from mambaloc.synthesis.posed_depth import Floats, PosedDepth

_KEY_FRAMES = 160
_SEARCHED_PX = 54  # shorter side, about: more takes longer, and finds no better depth
_POINTS_INSIDE = (0.01, 0.99)  # of the depths
_MARGIN = 1.3
_TRIAL_FRAMES, _TRIAL_OTHERS = 6, 1
_TRIAL_RANGE = (0.2, 40.0)  # of how far the cameras are spread
_MIN_KNOWN = 0.05
_AT_ONCE = 128  # images that are mapped


def depth_from_images(
    images: NDArray[np.uint8],
    intrinsics: Floats,
    world_from_cam: Floats,
    points_m: Floats | None = None,
    key_frames: int = _KEY_FRAMES,
    settings: SweepSettings | None = None,
    device: torch.device | str = "cpu",
) -> PosedDepth:
    """Search depth for some of the images, spread over the poses, and keep depths that several images confirm.

    Args:
        images: (N, 3, h, w) uint8.
        intrinsics: (N, 3, 3) in pixels of the images.
        world_from_cam: (N, 4, 4).
        points_m: (M, 3), a sparse map's or of structure from motion: they bound the depth. From images unless given.
        key_frames: how many at most.
        settings: of the search.
        device: that searches.

    Raises:
        InputError: where hardly any depth is confirmed: poses or cameras do not fit the images.
    """
    small, matrices = searched(images, intrinsics)
    if points_m is None:
        range_m = range_from_images(small, matrices, world_from_cam, device)
    else:
        range_m = range_of_points(points_m, intrinsics, world_from_cam, images.shape[2:])
    sweep = PlaneSweep(small, matrices, world_from_cam, range_m, settings, device)
    rows = spread_rows(world_from_cam, sweep.scale_m, key_frames)
    depth_m = enlarged(sweep.depth_m(rows), images.shape[2:])
    found = confirmed(PosedDepth(images[rows], depth_m, intrinsics[rows], world_from_cam[rows]))
    if np.isfinite(found.depth_m).mean() < _MIN_KNOWN:
        raise InputError(
            f"{len(images)} images: several images confirm no depth. Check poses and cameras, or do without views."
        )
    return found


def searched(images: NDArray[np.uint8], intrinsics: Floats) -> tuple[NDArray[np.uint8], Floats]:
    """Images and their cameras at the size at which depth is searched: a whole part of theirs, about 54 pixels."""
    height, width = images.shape[2:]
    part = max(1, round(min(height, width) / _SEARCHED_PX))
    if part == 1:
        return images, intrinsics
    size = (width // part, height // part)
    small = np.empty((len(images), 3, *size[::-1]), np.uint8)
    for row, each in enumerate(images):
        small[row] = cv2.resize(each.transpose(1, 2, 0), size, interpolation=cv2.INTER_AREA).transpose(2, 0, 1)
        if row % _AT_ONCE == 0:
            release_pages(images)
    scale = np.diag((size[0] / width, size[1] / height, 1.0))
    scale[:2, 2] = (scale[[0, 1], [0, 1]] - 1) / 2  # pixel centres
    return small, scale @ intrinsics


def enlarged(depth_m: NDArray[np.float32], size: tuple[int, ...]) -> NDArray[np.float32]:
    """Depth (S, h, w) at a size (height, width); inverse depth is linear between pixels."""
    if depth_m.shape[1:] == size:
        return depth_m
    return np.stack([1 / cv2.resize(1 / each, size[::-1], interpolation=cv2.INTER_LINEAR) for each in depth_m])


def range_of_points(
    points_m: Floats, intrinsics: Floats, world_from_cam: Floats, size: tuple[int, ...]
) -> tuple[float, float]:
    """Nearest and farthest depth at which cameras see points (M, 3), with a margin and without outliers."""
    depths = []
    for matrix, pose in zip(intrinsics, world_from_cam, strict=True):
        x, y, z = matrix @ ((points_m - pose[:3, 3]) @ pose[:3, :3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            is_seen = (z > 0) & (x / z >= 0) & (x / z < size[1]) & (y / z >= 0) & (y / z < size[0])
        depths.append(z[is_seen])
    near_m, far_m = np.quantile(np.concatenate(depths), _POINTS_INSIDE)
    return near_m / _MARGIN, far_m * _MARGIN


def range_from_images(
    images: NDArray[np.uint8], intrinsics: Floats, world_from_cam: Floats, device: torch.device | str = "cpu"
) -> tuple[float, float]:
    """Nearest and farthest depth that a few images confirm, searched within what the cameras' spread suggests.

    Raises:
        InputError: where they confirm none.
    """
    position_m = world_from_cam[:, :3, 3]
    spread_m = float(np.median(np.linalg.norm(position_m - np.median(position_m, axis=0), axis=1)))
    range_m = (_TRIAL_RANGE[0] * spread_m, _TRIAL_RANGE[1] * spread_m)
    for _ in range(2):  # the first answer chooses better neighbours for the second
        sweep = PlaneSweep(images, intrinsics, world_from_cam, range_m, device=device)
        middle = np.linspace(0, len(images) - 1, _TRIAL_FRAMES).round().astype(int).tolist()
        rows = np.unique([each for row in middle for each in (row, *sweep.neighbours(row)[:_TRIAL_OTHERS])])
        trial = PosedDepth(images[rows], sweep.depth_m(rows), intrinsics[rows], world_from_cam[rows])
        known_m = confirmed(trial, by=1).depth_m
        known_m = known_m[np.isfinite(known_m)]
        if not len(known_m):
            raise InputError(
                f"{len(images)} images: none confirms another's depth. Check poses and cameras, or do without views."
            )
        near_m, far_m = np.quantile(known_m, _POINTS_INSIDE)
        range_m = (near_m / _MARGIN, far_m * _MARGIN)
    return range_m


def spread_rows(world_from_cam: Floats, scale_m: float, count: int) -> NDArray[np.int64]:
    """Frames that are spread over the poses: each the farthest from those before it, in order of their rows."""
    place = np.hstack((world_from_cam[:, :3, 3] / scale_m, world_from_cam[:, :3, 2]))
    return farthest_points(place, count, first=0)
