"""The cameras of a scene's frames: those that the scene gives, or a usual one."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.colmap import COLMAP_FOLDERS, colmap_folder, is_sound, load_colmap, pinhole_of
from mambaloc.data.datasets.capture import FRAMES_FILE, SCENE_FILE, is_captured, read_rows, read_scene, scene_note
from mambaloc.data.frames import Cameras, Frames, plain_name
from mambaloc.data.nvm import NVM_FILE, read_nvm_cameras
from mambaloc.errors import InputError, InputWarning
from mambaloc.images import LARGEST_SIDE_PX, read_image
from mambaloc.runtime.undistortion import Undistortion

Floats = NDArray[np.float64]
Size = tuple[int, int]

ASSUMED_FOCAL = 0.87
"""Focal length over the longer side where a scene does not give it: that of Cambridge Landmarks' phone, whose models
have 1670 px at 1920x1080. Videos of most phones lie within a tenth of it."""

_SEVEN_SCENES_FOCAL = 525 / 640  # of the colour camera, over the width; 585 is the depth camera's


class UnknownCameraError(InputError):
    """A scene does not give its cameras."""


def known_cameras(dataset: str, folder: Path, frames: Frames) -> Cameras:
    """The cameras of frames as the scene gives them.

    An imported or rendered scene has them in ``scene.json``. 7-Scenes has one camera, of 525 px at a width of 640; its
    principal point is the image's centre. Other scenes have those of ``reconstruction.nvm`` or a COLMAP model, by
    image and without distortion; an image missing from the model gets its camera of median focal length.

    Args:
        dataset: its name.
        folder: of the scene.
        frames: of it, the first with a readable image; unless the cameras are by name, all images have its size.

    Raises:
        UnknownCameraError: where the scene does not give them.
        InputError: where what gives them is malformed.
    """
    if is_captured(folder):
        return _of_capture(folder, frames)
    height, width = read_image(frames.image_paths[0]).shape[:2]
    size, nvm, colmap = (width, height), folder / NVM_FILE, colmap_folder(folder)
    if "intrinsics_px" in (note := scene_note(folder)):
        return _repeated(_of_rendering(folder, note["intrinsics_px"]), size, frames)
    if dataset == "7scenes":
        return _repeated(_centered(_SEVEN_SCENES_FOCAL * width, size), size, frames)
    if nvm.is_file():
        cameras = read_nvm_cameras(nvm)
        focal_px = zip(cameras.names, cameras.focal_px, strict=True)
        return _of_model({name: _centered(focal, size) for name, focal in focal_px}, nvm, folder, size, frames)
    if colmap:
        return _of_model(_of_colmap(colmap, size), colmap, folder, size, frames)
    raise UnknownCameraError(
        f"{folder}: has no cameras: neither {NVM_FILE} nor a COLMAP model in "
        f"{' or '.join(COLMAP_FOLDERS)}. Add such a file, or import the scene with mambaloc import."
    )


def frame_intrinsics(dataset: str, folder: Path, frames: Frames) -> Floats:
    """Pinhole matrices of frames, (N, 3, 3), in pixels of each image; arguments and errors of :func:`known_cameras`.

    What needs the true cameras, such as a map, asks here.
    """
    return known_cameras(dataset, folder, frames).intrinsics


def known_or_assumed_cameras(dataset: str, folder: Path, frames: Frames) -> Cameras:
    """The cameras of frames; where the scene does not give them, :data:`ASSUMED_FOCAL`, with a warning.

    Raises:
        InputError: where what gives them is malformed.
    """
    try:
        return known_cameras(dataset, folder, frames)
    except UnknownCameraError as error:
        assumed = f"A focal length of {ASSUMED_FOCAL:g} of the images' longer side is assumed."
        warnings.warn(f"{error} {assumed}", InputWarning, stacklevel=2)
    height, width = read_image(frames.image_paths[0]).shape[:2]
    return replace(_repeated(assumed_intrinsics((width, height)), (width, height), frames), is_assumed=True)


def assumed_intrinsics(size: Size) -> Floats:
    """The usual camera's pinhole matrix, (3, 3), for images of a size (width, height)."""
    return _centered(ASSUMED_FOCAL * max(size), size)


def undistortion_of(folder: Path) -> Undistortion:
    """How a scene's training images were made of what their camera stored, where all are of one.

    Raises:
        InputError: where ``scene.json`` says of it what cannot be read.
    """
    if not is_captured(folder):
        return Undistortion(unknown="their scene was not imported")
    names = {row.camera for row in read_rows(folder) if row.split == "train"}
    if len(names) != 1:
        return Undistortion(unknown=f"they are of {len(names)} cameras")
    cameras_json = read_scene(folder).get("cameras")
    camera = cameras_json.get(*names) if isinstance(cameras_json, dict) else None
    if not isinstance(camera, dict):
        return Undistortion(unknown="their scene does not describe their camera")
    if "adjusted_from" in camera:
        return Undistortion(unknown="its focal length was adjusted after they were undistorted")
    if "lens" not in camera:
        return Undistortion(unknown="they were imported as they are, as those of a pinhole")
    try:
        return Undistortion.from_json({"lens": camera["lens"], "leaves": camera})
    except ValueError as error:
        raise InputError(f"{folder / SCENE_FILE}: {error}. Correct it, or import the scene again.") from None


def _centered(focal_px: float, size: Size) -> Floats:
    return _pinhole(focal_px, focal_px, (size[0] - 1) / 2, (size[1] - 1) / 2)


def _pinhole(fx: float, fy: float, cx: float, cy: float) -> Floats:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _repeated(matrix: Floats, size: Size, frames: Frames) -> Cameras:
    return Cameras(np.tile(matrix, (len(frames), 1, 1)), np.tile(size, (len(frames), 1)))


def _of_rendering(folder: Path, intrinsics: Any) -> Floats:
    try:
        matrix = np.array(intrinsics, np.float64)
    except (ValueError, TypeError):
        matrix = np.empty(0)
    is_pinhole = matrix.shape == (3, 3) and np.isfinite(matrix).all() and min(matrix[0, 0], matrix[1, 1]) > 0
    if not is_pinhole or not np.array_equal(matrix, _pinhole(matrix[0, 0], matrix[1, 1], *matrix[:2, 2])):
        raise InputError(
            f"{folder / SCENE_FILE}: intrinsics_px must be a 3x3 matrix 'fx 0 cx, 0 fy cy, 0 0 1' in pixels. "
            "Correct it, or render the scene again."
        )
    return matrix


def _of_model(matrices: dict[str, Floats], model: Path, folder: Path, size: Size, frames: Frames) -> Cameras:
    """Each frame's camera by its name in a model, and the one of median focal length for frames missing from it."""
    rows = {name: row for name, row in frames.rows_by_name(folder).items() if name in matrices}
    if not rows:
        raise UnknownCameraError(
            f"{model}: has no camera of {len(frames)} frames, such as {frames.image_paths[0]}. "
            "Name the model's images by their path in the scene's folder."
        )
    known = sorted((matrices[name] for name in rows), key=lambda matrix: float(matrix[0, 0]))
    cameras = _repeated(known[len(known) // 2], size, frames)
    for name, row in rows.items():
        cameras.intrinsics[row] = matrices[name]
    return cameras


def _of_colmap(path: Path, size: Size) -> dict[str, Floats]:
    model = load_colmap(path)
    if not all(is_sound(camera) for camera in model.cameras.values()):
        raise InputError(f"{path}: holds a camera without a size or a finite, positive focal length; export it again")
    return {plain_name(each.name): pinhole_of(model.cameras[each.camera_id], size) for each in model.images.values()}


def _of_capture(folder: Path, frames: Frames) -> Cameras:
    camera_of = {row.image: row.camera for row in read_rows(folder)}
    names = [camera_of[image] for image in frames.image_paths]
    cameras_json = read_scene(folder).get("cameras")
    cameras = {name: _captured(folder / SCENE_FILE, cameras_json, name) for name in {*names}}
    return Cameras(np.stack([cameras[name][0] for name in names]), np.array([cameras[name][1] for name in names]))


def _captured(path: Path, cameras_json: Any, name: str) -> tuple[Floats, Size]:
    """Matrix of a camera of ``scene.json``, and size of its images."""
    camera = cameras_json.get(name) if isinstance(cameras_json, dict) else None
    if camera is None or (isinstance(camera, dict) and not {"focal_px", "centre_px"} <= set(camera)):
        raise UnknownCameraError(
            f"{path}: has no focal length and centre of camera {name!r}. Import the scene with its intrinsics, "
            "or add 'width', 'height', 'focal_px': [x, y] and 'centre_px': [x, y] under 'cameras' there, and the "
            f"camera's name to {FRAMES_FILE}."
        )
    try:
        size = int(camera["width"]), int(camera["height"])
        matrix = _pinhole(*map(float, (*camera["focal_px"], *camera["centre_px"])))
        is_camera = np.isfinite(matrix).all() and min(matrix[0, 0], matrix[1, 1]) > 0
        is_camera = is_camera and 1 <= min(size) <= max(size) <= LARGEST_SIDE_PX
    except (TypeError, ValueError, KeyError, OverflowError):
        is_camera = False
    if not is_camera:
        raise InputError(
            f"{path}: camera {name!r} must have 'width' and 'height', and 'focal_px' and 'centre_px' of two numbers "
            "each, in pixels. Correct it, or import the scene again."
        )
    return matrix, size
