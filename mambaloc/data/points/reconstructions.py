"""What a structure-from-motion model says of some frames, whatever file it came in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mambaloc.data.frames import FARTHEST_M, Frames
from mambaloc.data.points.scene_points import Points, ScenePoints, Source, choose, frame_rng, stacked
from mambaloc.errors import InputError
from mambaloc.geometry import rotation_error_deg

TOLERANCE_M = 0.1
TOLERANCE_DEG = 1.0


@dataclass(frozen=True)
class Reconstruction:
    """The M cameras of a model that are among the frames asked for, and the points that each sees.

    Shape:
        ``rows`` (M,), each camera's row among the frames; ``position_m`` (M, 3) and ``quaternion`` (M, 4), its
        ``world_from_cam``; ``points_m`` holds M arrays (K, 3).
    """

    rows: NDArray[np.int64]
    position_m: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    points_m: Sequence[Points]


def points_of_frames(
    model: Reconstruction, file: Path, frames: Frames, count: int, seed: int, source: Source
) -> ScenePoints:
    """Each frame's points, at most ``count``. A frame that the model does not know, or knows in another pose, has none.

    Raises:
        InputError: where no frame is in the model, or most have another pose there.
    """
    if not len(model.rows):
        raise InputError(
            f"{file}: contains none of {len(frames)} frames, such as {frames.image_paths[0]}; "
            "name the model's images by their path in the scene's folder"
        )
    agrees = _agrees(model, file, frames)
    points: list[Points] = [np.empty((0, 3))] * len(frames)
    for camera in np.flatnonzero(agrees).tolist():
        row = model.rows[camera]
        seen = model.points_m[camera]
        # Points farther from the world's origin are triangulated from nearly parallel rays.
        near = seen[np.abs(seen).max(axis=1, initial=0) <= FARTHEST_M]
        points[row] = choose(near, count, frame_rng(seed, frames.image_paths[row]))
    return ScenePoints(stacked(points, count), source)


def _agrees(model: Reconstruction, file: Path, frames: Frames) -> NDArray[np.bool_]:
    """Which cameras have the dataset's pose, (M,)."""
    distance_m = np.linalg.norm(model.position_m - frames.position_m[model.rows], axis=1)
    true = torch.from_numpy(frames.quaternion[model.rows])
    rotation_deg = rotation_error_deg(torch.from_numpy(model.quaternion), true).numpy()
    agrees = (distance_m <= TOLERANCE_M) & (rotation_deg <= TOLERANCE_DEG)
    if agrees.mean() < 0.5:
        raise InputError(
            f"{file}: its cameras are up to {distance_m.max():.3g} m and {rotation_deg.max():.3g} degrees off the "
            f"dataset's poses, more than {TOLERANCE_M:g} m and {TOLERANCE_DEG:g} degrees; bring the model into their "
            "frame and scale (colmap model_aligner), or remove it"
        )
    return agrees
