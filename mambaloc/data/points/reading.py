"""Find a scene's points: in depth frames, an NVM model, a COLMAP model, or tracks of an import, in this order."""

from __future__ import annotations

from pathlib import Path

from mambaloc.data.colmap import COLMAP_FOLDERS, colmap_folder
from mambaloc.data.depth_frames import depth_path
from mambaloc.data.frames import Cameras, Frames
from mambaloc.data.nvm import NVM_FILE
from mambaloc.data.points.colmap import read_colmap_points
from mambaloc.data.points.depth import depth_rows, read_depth_points
from mambaloc.data.points.nvm import read_nvm_points
from mambaloc.data.points.scene_points import ScenePoints
from mambaloc.data.points.tracks import read_track_points
from mambaloc.data.tracks import POINTS_FILE
from mambaloc.errors import InputError


def read_points(folder: Path, frames: Frames, cameras: Cameras, count: int, seed: int) -> ScenePoints:
    """Read scene points that frames may see.

    Args:
        folder: the scene's.
        frames: the N frames asked for, with readable images.
        cameras: of these.
        count: points a frame, P; where there are more, a draw that depends on the seed and the frame's name alone.
        seed: of the draw.

    Returns:
        N rows in the order of ``frames``; a frame without any point is all NaN.

    Raises:
        InputError: where there is no source of points, it is malformed, or no frame has any point.
    """
    if depth_rows(frames):
        points = read_depth_points(folder, frames, cameras, count, seed)
    elif (folder / NVM_FILE).is_file():
        points = read_nvm_points(folder, frames, count, seed)
    elif colmap_folder(folder):
        points = read_colmap_points(folder, frames, count, seed)
    elif (folder / POINTS_FILE).is_file():
        points = read_track_points(folder, frames, count, seed)
    else:
        raise InputError(
            f"{folder}: has no scene points for data.points_per_frame: no depth frame such as "
            f"{depth_path(frames.image_paths[0]).relative_to(folder)}, no {NVM_FILE}, no COLMAP model in "
            f"{' or '.join(COLMAP_FOLDERS)}; add such a file, or set data.points_per_frame to 0"
        )
    if not points.per_frame().any():
        raise InputError(
            f"{folder}: its {points.source} has no point for any of {len(frames)} frames; "
            "repair it, or choose a model that needs no points"
        )
    return points
