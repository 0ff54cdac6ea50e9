"""Scene points from depth frames: ``frame-NNNNNN.depth.png`` beside the images, as 7-Scenes lays them out.

The depth sensor and the colour camera are taken to be in one place and to look one way; they are 25 mm apart.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from mambaloc.data.depth_frames import NO_DEPTH_MM, depth_path, read_depth_intrinsics, read_depth_mm
from mambaloc.data.frames import Cameras, Frames
from mambaloc.data.points.scene_points import Points, ScenePoints, choose, frame_rng, stacked
from mambaloc.errors import InputError
from mambaloc.geometry import project, transform
from mambaloc.types import Pose


def depth_rows(frames: Frames) -> list[int]:
    """Rows of the frames that have a depth frame of their own."""
    return [row for row, image in enumerate(frames.image_paths) if depth_path(image).is_file()]


def read_depth_points(folder: Path, frames: Frames, cameras: Cameras, count: int, seed: int) -> ScenePoints:
    """Draw pixels of each frame's depth and carry them to the world by the frame's true pose.

    A frame without depth of its own gets the points of its sequence's nearest depth frames, one before and one after,
    that project into its image; only depth of ``frames`` is read, so no held-out frame lends any.

    Args:
        folder: the scene's.
        frames: the frames asked for, of which one at least has depth.
        cameras: of their images.
        count: points a frame, P.
        seed: of the draw.

    Raises:
        InputError: for a depth frame that cannot be read or is of another size than the first, or bad intrinsics.
    """
    rows = depth_rows(frames)
    size = _size(read_depth_mm(depth_path(frames.image_paths[rows[0]])))
    intrinsics = read_depth_intrinsics(folder, size)
    points: list[Points] = [np.empty((0, 3))] * len(frames)
    with ThreadPoolExecutor() as pool:
        sampled = pool.map(lambda row: _sample(frames, row, intrinsics, size, count, seed), rows)
        for row, sample in zip(rows, track(sampled, "Reading depth", len(rows), transient=True), strict=True):
            points[row] = sample
    lenders = _lenders(frames, rows)
    for row, lent_by in track(lenders.items(), "Sharing points", transient=True):
        lent = _in_view(np.concatenate([points[lender] for lender in lent_by]), frames, cameras, row)
        points[row] = choose(lent, count, frame_rng(seed, frames.image_paths[row]))
    return ScenePoints(stacked(points, count), "depth")


def _size(depth_mm: NDArray[np.uint16]) -> tuple[int, int]:
    height, width = depth_mm.shape
    return width, height


def _sample(
    frames: Frames, row: int, intrinsics: NDArray[np.float64], size: tuple[int, int], count: int, seed: int
) -> Points:
    """World points of pixels drawn from those that have a depth, (K, 3)."""
    image = frames.image_paths[row]
    depth_mm = read_depth_mm(depth_path(image))
    if _size(depth_mm) != size:
        sizes = f"{depth_mm.shape[1]}x{depth_mm.shape[0]}, where the first depth frame is {size[0]}x{size[1]}"
        raise InputError(f"{depth_path(image)}: is {sizes}; resize it, or remove it to do without it")
    measured = np.flatnonzero(~np.isin(depth_mm, NO_DEPTH_MM))
    drawn = frame_rng(seed, image).choice(measured, min(count, len(measured)), replace=False, shuffle=False)
    y, x = np.divmod(drawn, size[0])
    rays = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(intrinsics).T
    points_cam = rays * (depth_mm.ravel()[drawn, None] / 1000.0)
    return transform(_pose(frames, row), torch.from_numpy(points_cam)).numpy()


def _lenders(frames: Frames, rows: list[int]) -> dict[int, NDArray[np.int64]]:
    """For each frame without depth, the nearest depth frames before and after it in its sequence."""
    lenders = {}
    for indices in frames.by_sequence().values():
        with_depth = indices[np.isin(indices, rows)]
        for row in np.setdiff1d(indices, with_depth).tolist():
            after = int(np.searchsorted(with_depth, row))
            if len(with_depth):
                lenders[row] = with_depth[max(0, after - 1) : after + 1]
    return lenders


def _in_view(points_m: Points, frames: Frames, cameras: Cameras, row: int) -> Points:
    """Those of the points that lie in front of a frame's camera and project into its image."""
    cam_from_world = _pose(frames, row).inverse()
    points_cam = transform(cam_from_world, torch.from_numpy(points_m))
    pixels = project(points_cam, torch.from_numpy(cameras.intrinsics[row])).numpy()
    inside = ((pixels >= -0.5) & (pixels < cameras.size_px[row] - 0.5)).all(axis=1)
    return points_m[inside & (points_cam[:, 2] > 0).numpy()]


def _pose(frames: Frames, row: int) -> Pose:
    return Pose(torch.from_numpy(frames.position_m[row]), torch.from_numpy(frames.quaternion[row]))
