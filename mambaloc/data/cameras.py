"""The cameras of a scene's frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.datasets.capture import SCENE_FILE, is_captured, read_rows, read_scene, scene_note
from mambaloc.data.frames import Frames
from mambaloc.errors import InputError
from mambaloc.images import read_image

Floats = NDArray[np.float64]

_SEVEN_SCENES_FOCAL = 525 / 640  # of the colour camera, over the width; 585 is the depth camera's


def frame_intrinsics(dataset: str, folder: Path, frames: Frames) -> Floats:
    """Pinhole matrices of frames, in pixels of each picture.

    An imported or rendered scene says them in ``scene.json``; 7-Scenes has one camera, of 525 px at a width of 640,
    whose centre is the picture's.

    Args:
        dataset: its name.
        folder: of the scene.
        frames: of it.

    Returns:
        (N, 3, 3).

    Raises:
        InputError: where they are unknown.
    """
    if is_captured(folder):
        return _of_capture(folder, frames)
    if (matrix := _of_rendering(folder)) is not None:
        return np.repeat(matrix[None], len(frames), axis=0)
    if dataset == "7scenes":
        height, width = read_image(frames.image_paths[0]).shape[:2]
        focal_px = _SEVEN_SCENES_FOCAL * width
        return np.repeat(_pinhole(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)[None], len(frames), axis=0)
    raise InputError(f"{folder}: the cameras of {dataset} are not read yet. Import it with tools/import_scene.py.")


def _pinhole(fx: float, fy: float, cx: float, cy: float) -> Floats:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _of_rendering(folder: Path) -> Floats | None:
    try:
        matrix = np.array(scene_note(folder)["intrinsics_px"], np.float64)
    except (ValueError, KeyError, TypeError):
        return None
    return matrix if matrix.shape == (3, 3) and np.isfinite(matrix).all() else None


def _of_capture(folder: Path, frames: Frames) -> Floats:
    path, cameras = folder / SCENE_FILE, read_scene(folder).get("cameras")
    camera_of = {row.image: row.camera for row in read_rows(folder)}
    matrices = {}
    for name in {camera_of[image] for image in frames.image_paths}:
        try:
            camera = cameras[name]  # type: ignore[index]
            matrices[name] = _pinhole(*map(float, (*camera["focal_px"], *camera["centre_px"])))
        except (TypeError, ValueError, KeyError):
            raise InputError(
                f"{path}: does not say focal length and centre of camera {name!r}, which a map needs. "
                "Import the scene with its intrinsics."
            ) from None
    return np.stack([matrices[camera_of[image]] for image in frames.image_paths])
