"""Scene points from the model that Cambridge Landmarks scenes ship with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mambaloc.data.frames import Frames
from mambaloc.data.nvm import NVM_FILE, read_nvm
from mambaloc.data.points.reconstructions import Reconstruction, points_of_frames
from mambaloc.data.points.scene_points import ScenePoints
from mambaloc.runtime.rotations import canonical, conjugate


def read_nvm_points(folder: Path, frames: Frames, count: int, seed: int) -> ScenePoints:
    """Draw, of each frame, points whose track lists its image; the arguments of ``read_depth_points``.

    Raises:
        InputError: for a file that is malformed, has none of the frames, or has them in other poses.
    """
    path, rows = folder / NVM_FILE, frames.rows_by_name(folder)
    cameras, seen = read_nvm(path, set(rows))
    known = [*seen]
    model = Reconstruction(
        np.array([rows[cameras.names[camera]] for camera in known], int),
        cameras.center_m[known],
        canonical(conjugate(cameras.cam_from_world[known])),
        [np.array(points).reshape(-1, 3) for points in seen.values()],
    )
    return points_of_frames(model, path, frames, count, seed, "nvm")
