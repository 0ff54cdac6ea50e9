"""Scene points from depth frames: ``frame-NNNNNN.depth.png`` beside the images, as 7-Scenes lays them out.

A depth frame holds ``uint16`` millimetres along the optical axis; 0 and 65535 are pixels without a measurement. Its
camera is ``SCENE/camera-intrinsics.txt`` (3x3, pixels of the depth frames) or, without such a file, the official depth
sensor, whose view is narrower than the colour camera's: 585 px where that has 525. Both are taken to be in one place
and to look one way; they are 25 mm apart.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from mambaloc.data.frames import Cameras, Frames
from mambaloc.data.points.scene_points import Points, ScenePoints, choose, frame_rng, stacked
from mambaloc.errors import InputError
from mambaloc.geometry import project, resized_intrinsics, transform
from mambaloc.text import decode_text
from mambaloc.types import Pose

INTRINSICS_FILE = "camera-intrinsics.txt"
_OFFICIAL_INTRINSICS = np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]])
_OFFICIAL_SIZE = (640, 480)
NO_DEPTH_MM = (0, 65535)
"""What a depth frame has at pixels without a measurement."""
_PNG_END = b"IEND\xaeB`\x82"  # OpenCV fills what a truncated file lacks with zeros and says nothing


def depth_path(image: Path) -> Path:
    """Where the depth frame of an image is, if it has one."""
    return image.with_name(f"{image.name.partition('.')[0]}.depth.png")


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


def read_whole_png(path: Path) -> NDArray[Any] | None:
    """The numbers of a PNG as they are stored; None where the file cannot be read, or is not whole."""
    try:
        data = path.read_bytes()
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data.endswith(_PNG_END) else None
    except (OSError, cv2.error):
        return None


def read_depth_mm(path: Path) -> NDArray[np.uint16]:
    """Read a depth frame, (H, W).

    Raises:
        InputError: where it is not a complete 16-bit PNG of one channel.
    """
    depth_mm = read_whole_png(path)
    if depth_mm is None or depth_mm.dtype != np.uint16 or depth_mm.ndim != 2:
        raise InputError(f"{path}: is not a complete 16-bit PNG of one channel. Repair or remove it.")
    return depth_mm


def _size(depth_mm: NDArray[np.uint16]) -> tuple[int, int]:
    height, width = depth_mm.shape
    return width, height


def read_depth_intrinsics(folder: Path, size: tuple[int, int]) -> NDArray[np.float64]:
    """The camera of depth frames of a size (width, height), (3, 3).

    Raises:
        InputError: where the folder's file of it does not hold a pinhole matrix.
    """
    path = folder / INTRINSICS_FILE
    if not path.is_file():
        scale = (size[0] / _OFFICIAL_SIZE[0], size[1] / _OFFICIAL_SIZE[1])
        return resized_intrinsics(torch.from_numpy(_OFFICIAL_INTRINSICS), *scale).numpy()
    try:
        lines = decode_text(path.read_bytes()).splitlines()
        matrix = np.array([line.split() for line in lines if line.strip()], dtype=float)
    except (ValueError, OSError):
        matrix = np.empty(0)
    is_pinhole = matrix.shape == (3, 3) and np.isfinite(matrix).all() and np.allclose(matrix[2], (0, 0, 1))
    if not is_pinhole or min(matrix[0, 0], matrix[1, 1]) <= 0 or matrix[1, 0] != 0:
        raise InputError(f"{path}: is not a pinhole matrix 'fx 0 cx, 0 fy cy, 0 0 1' in pixels; correct or remove it")
    return matrix


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
