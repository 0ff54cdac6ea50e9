"""Scene points from a COLMAP model in ``SCENE/sparse/0`` or ``SCENE/sparse``, text or binary.

Images are named by their path in the scene's folder, with whatever suffix.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from mambaloc.data.colmap import COLMAP_FOLDERS, colmap_folder, load_colmap
from mambaloc.data.frames import Frames, plain_name
from mambaloc.data.points.reconstructions import Reconstruction, points_of_frames
from mambaloc.data.points.scene_points import ScenePoints
from mambaloc.errors import InputError
from mambaloc.geometry import quaternion_from_matrix


def read_colmap_points(folder: Path, frames: Frames, count: int, seed: int) -> ScenePoints:
    """Draw, of each frame, points that its image observes; the arguments of ``read_depth_points``.

    Raises:
        InputError: without pycolmap, or for a model that it cannot read, that has none of the frames, or has them
            in other poses.
    """
    path = colmap_folder(folder)
    if path is None:
        raise InputError(
            f"{folder / COLMAP_FOLDERS[0]}: contains no COLMAP model; put its cameras, images, points3D there"
        )
    rows = frames.rows_by_name(folder)
    model = load_colmap(path)
    images = [image for image in model.images.values() if image.has_pose and plain_name(image.name) in rows]
    cam_from_world = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    known = Reconstruction(
        np.array([rows[plain_name(image.name)] for image in images], dtype=np.int64),
        np.array([image.projection_center() for image in images]).reshape(-1, 3),
        quaternion_from_matrix(torch.from_numpy(cam_from_world[:, :, :3].transpose(0, 2, 1).copy())).numpy(),
        [_observed(model, image) for image in track(images, "Reading points", transient=True)],
    )
    return points_of_frames(known, path, frames, count, seed, "colmap")


def _observed(model: Any, image: Any) -> NDArray[np.float64]:
    """The points that an image observes; ids without a point, as in a text that is cut off, are passed over."""
    ids = [point.point3D_id for point in image.get_observation_points2D()]
    points = [model.points3D[number].xyz for number in ids if model.exists_point3D(number)]
    return np.array(points, dtype=np.float64).reshape(-1, 3)
