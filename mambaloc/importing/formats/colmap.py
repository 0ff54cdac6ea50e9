"""COLMAP models, text or binary, with any of its camera models.

The model lies in ``SOURCE/sparse``, SOURCE or ``SOURCE/colmap/sparse``, or a numbered folder there: of several, the one
with most images is read. Its images lie in ``SOURCE/images``, a smaller copy of that, or beside.
COLMAP's poses turn the world into the camera, in OpenCV's camera axes and an arbitrary scale; its pixels are counted
from the corner of the top-left one, half a pixel more than here. Source: colmap.github.io/format.html and cameras.html
there; poses and projections are pycolmap's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.colmap import colmap_models, is_sound, load_colmap
from mambaloc.data.colmap_text import count_images
from mambaloc.data.tracks import Tracks
from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX, LARGEST_SIDE_PX
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.formats.builder import Posed, build_capture, from_quaternions
from mambaloc.importing.formats.finding import SMALLER, Found, count_there, find_images
from mambaloc.importing.formats.parsing import folder_name, images_in_same_folders
from mambaloc.runtime.camera_models import FisheyeModel, OpenCVModel
from mambaloc.text import natural

_ROOTS = ("sparse", ".", "colmap/sparse")
_NAMED = 3  # other models
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
_OPENCV = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYES = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")


def is_colmap(source: Path) -> bool:
    """Whether a folder is, or holds, a COLMAP model."""
    return bool(colmap_models(source, _ROOTS))


def read_colmap(source: Path, images: Path | None = None) -> Capture:
    """Read the images of a model that have a pose there, and their cameras.

    Args:
        source: the model's folder, or a scene's.
        images: the folder that image names are relative to; found unless given.

    Raises:
        InputError: without pycolmap, or for a model that is damaged, or whose images are not there.
    """
    models = colmap_models(source, _ROOTS)
    if not models:
        raise InputError(f"{source}: contains no COLMAP model; give the folder of cameras, images and points3D")
    path = models[0]
    model = load_colmap(path)
    placed = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: _key(image.name))
    if not placed:
        raise InputError(f"{path}: places none of its {len(model.images)} images; reconstruct again")
    found = _find(source, path, images, [image.name for image in placed])
    # A text's quaternions are as they were written: pycolmap makes them no unit.
    cam_from_world = [image.cam_from_world() for image in placed]
    checked = from_quaternions(
        np.array([each.translation for each in cam_from_world]),
        np.roll([each.rotation.quat for each in cam_from_world], 1, axis=1),
        lambda row: f"{path}, image {placed[row].name[:80]!r}",
    )
    world_from_cam = checked.inverse()
    cameras = {f"camera-{number}": _camera(model.cameras[number], path) for number in _used(placed)}
    posed, missing = [], []
    for row, (image, file) in enumerate(zip(placed, found.files, strict=True)):
        if file not in found.missing:
            sequence, camera = _sequence(image.name, source), f"camera-{image.camera_id}"
            posed.append(Posed(file, sequence, world_from_cam[row], camera))
        else:
            missing.append(image.name)
    choices = {
        "axes": "OpenCV camera axes, as COLMAP has them",
        "direction": "world-to-camera in the file, inverted",
        "scale": "unknown: COLMAP's is arbitrary",
        "origin": "kept",
        "model": _model_choice(source, models),
        **found.choices,
        **checked.choices,
    }
    beside = images_in_same_folders(each.image for each in posed)
    capture = build_capture(
        "colmap", source, posed, unit="unknown", choices=choices, cameras=cameras, missing=missing, beside=beside
    )
    image_of = dict(zip(found.files, placed, strict=True))
    return replace(capture, tracks=_tracks(model, [image_of[file] for file in capture.images]))


def _tracks(model: Any, images: list[Any]) -> Tracks | None:
    """The model's points and where the images see them; ids without a point, as in a cut-off text, are left out."""
    place_of = {number: point.xyz for number, point in model.points3D.items() if np.isfinite(point.xyz).all()}
    row_of = {number: row for row, number in enumerate(sorted(place_of))}
    points, frames, rays = [], [], []
    for row, image in enumerate(images):
        seen = [point for point in image.get_observation_points2D() if point.point3D_id in row_of]
        pixels = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
        ray = np.asarray(model.cameras[image.camera_id].cam_from_img(pixels), np.float64).reshape(-1, 2)
        is_seen = np.isfinite(ray).all(axis=1)  # a lens may not see where a pixel looks
        points.append(np.array([row_of[point.point3D_id] for point in seen], np.int64)[is_seen])
        frames.append(np.full(is_seen.sum(), row, np.int64))
        rays.append(ray[is_seen])
    points_m = np.array([place_of[number] for number in row_of], np.float64).reshape(-1, 3)
    tracks = Tracks(points_m, np.concatenate(points), np.concatenate(frames), np.concatenate(rays))
    return tracks.of_frames(np.arange(len(images))) or None


def _key(name: str) -> tuple[tuple[int, str, int, str], ...]:
    return natural(Path(name))


def _used(images: list[Any]) -> list[int]:
    return sorted({image.camera_id for image in images})


def _model_choice(source: Path, models: list[Path]) -> str:
    """Which model was read, and which were not."""
    first, *others = (model.relative_to(source).as_posix() for model in models)
    if not others:
        return first
    named = ", ".join(f"{name} ({count_images(source / name)} images)" for name in others[:_NAMED])
    return f"{first}, with most images of {len(models)}; not read: {named}" + (", ..." if len(others) > _NAMED else "")


def _find(source: Path, model: Path, images: Path | None, names: list[str]) -> Found:
    """The images in the given folder, or in the first folder that has most images."""
    folders = [source / "images", source, *(source / f"images{end}" for end in SMALLER)]
    if source in (model, model.parent):  # a model's own folder, such as sparse/0: images are beside sparse
        root = source.resolve()
        folders += [root.parent / "images", root.parent.parent / "images"]
    folder, best_count = images or source, 0
    for candidate in folders if images is None else ():
        count = count_there(candidate, names)
        folder, best_count = (candidate, count) if count > best_count else (folder, best_count)
        if best_count == len(names):
            break
    return find_images(folder, [(name, f"{model}, images") for name in names])


def _sequence(name: str, source: Path) -> str:
    """The folder in an image's name, as recordings are kept apart; else the source's own."""
    parent = Path(name.replace("\\", "/")).parent.as_posix()
    return folder_name(source) if parent == "." else parent


def _camera(camera: Any, path: Path) -> Camera:
    if not is_sound(camera):
        raise InputError(f"{path}: holds a camera without a size or a finite, positive focal length; export it again")
    if max(camera.width, camera.height) > LARGEST_SIDE_PX:
        raise InputError(
            f"{path}: a camera has {camera.width}x{camera.height} pixels, more than {LARGEST_SIDE_PX} a side. "
            "Make smaller images, and reconstruct from these."
        )
    model = str(camera.model_name)
    focal_px, center_px = _pinhole(camera)
    lens = None if model in _PINHOLES else _lens(camera)
    return Camera(int(camera.width), int(camera.height), focal_px, center_px, lens, model)


def _pinhole(camera: Any) -> tuple[tuple[float, float], tuple[float, float]]:
    focal_px = float(camera.focal_length_x), float(camera.focal_length_y)
    return focal_px, (float(camera.principal_point_x) - CORNER_PX, float(camera.principal_point_y) - CORNER_PX)


def _lens(camera: Any) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """The same lens in OpenCV's terms, where it has some; or else pycolmap's, NaN for rays that it does not see."""
    coefficients = [float(camera.params[at]) for at in camera.extra_params_idxs()]
    for model, names in ((OpenCVModel, _OPENCV), (FisheyeModel, _FISHEYES)):
        if camera.model_name in names:
            return model(*_pinhole(camera), coefficients + [0.0] * (min(model.counts) - len(coefficients)))

    def distorted(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        points: NDArray[np.float64] = np.column_stack([rays, np.ones(len(rays))])
        return camera.img_from_cam(points) - CORNER_PX

    return distorted
