"""Scene points that an imported scene's structure from motion found, from its ``points.safetensors``."""

from __future__ import annotations

from pathlib import Path

from mambaloc.data.frames import Frames
from mambaloc.data.points.scene_points import ScenePoints, choose, frame_rng, stacked
from mambaloc.data.tracks import POINTS_FILE, tracks_of_frames
from mambaloc.errors import InputError


def read_track_points(folder: Path, frames: Frames, count: int, seed: int) -> ScenePoints:
    """Draw, of each frame, points that it observes; the arguments of ``read_depth_points``.

    Raises:
        InputError: where the scene has no such file, or it is damaged.
    """
    tracks = tracks_of_frames(folder, frames)
    if tracks is None:
        raise InputError(f"{folder / POINTS_FILE}: no such file. Import the scene again.")
    seen = [tracks.points_m[tracks.point[tracks.frame == row]] for row in range(len(frames))]
    drawn = [
        choose(points_m, count, frame_rng(seed, image))
        for points_m, image in zip(seen, frames.image_paths, strict=True)
    ]
    return ScenePoints(stacked(drawn, count), "tracks")
