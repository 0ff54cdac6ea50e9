"""Cameras of ``transforms.json``: one for all frames, or one a frame.

Their pixels count from the image's corner: the centre of the top-left pixel is (0.5, 0.5), as in COLMAP.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX, LARGEST_SIDE_PX, stored_size
from mambaloc.importing.capture import Camera
from mambaloc.runtime.camera_models import FisheyeModel, OpenCVModel

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
KEYS = (
    *("camera_model", "is_fisheye", "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y"),
    *_COEFFICIENTS,
)
"""What a file, or a frame of it, says of a camera."""

_BROWN = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
_MAX_FOCAL_PX = 1e7


def read_cameras(
    intrinsics: Sequence[Mapping[str, Any]], images: Sequence[Path], file: Path
) -> tuple[dict[str, Camera], list[str | None], str]:
    """Make a camera of each distinct set of intrinsics.

    Args:
        intrinsics: of N frames, by :data:`KEYS`.
        images: their files, all there.
        file: that holds them, for messages.

    Returns:
        Cameras by name; the name of each frame's camera, None where the file has no focal lengths; what was decided.

    Raises:
        InputError: for intrinsics that no camera has, or that are missing for some frames.
    """
    has_focal = [any(key in each for key in ("fl_x", "camera_angle_x")) for each in intrinsics]
    if not any(has_focal):
        return {}, [None] * len(images), "none: the file has no focal length"
    if not all(has_focal):
        raise InputError(f"{file}: some frames have a focal length, {images[has_focal.index(False)]} has none; add it")
    keys = [repr(sorted(each.items())) for each in intrinsics]
    frames: dict[str, list[int]] = {}
    for row, key in enumerate(keys):
        frames.setdefault(key, []).append(row)
    names = {key: f"camera-{count}" for count, key in enumerate(frames, start=1)}
    cameras = {
        names[key]: _camera(
            intrinsics[rows[0]], [images[row] for row in rows], f"{file}: camera of {images[rows[0]].name}"
        )
        for key, rows in frames.items()
    }
    return cameras, [names[key] for key in keys], _summary(cameras)


def number(content: Mapping[str, Any], key: str, where: str) -> float | None:
    """A finite number, or None without one.

    Raises:
        InputError: for anything else.
    """
    value = content.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        raise InputError(f"{where}: {key} is {str(value)[:40]!r}, not a finite number; correct it")
    return float(value)


def _camera(content: Mapping[str, Any], images: Sequence[Path], where: str) -> Camera:
    """A camera in pixels of the size in the file, or else of the first of its own images."""
    size = [number(content, key, where) for key in "wh"]
    sides = [side for side in size if side] if all(size) else list(map(float, first_size(images)))
    focal = [_focal(content, axis, sides[axis], where) for axis in (0, 1)]
    focal_px = (focal[0], focal[1]) if focal[0] and focal[1] else (focal[0] or focal[1],) * 2
    center = [number(content, key, where) for key in ("cx", "cy")]
    center_px = [side / 2 if at is None else at for at, side in zip(center, sides, strict=True)]
    if not all(1 <= side <= LARGEST_SIDE_PX for side in sides) or not all(0 < f < _MAX_FOCAL_PX for f in focal_px):
        raise InputError(f"{where}: {sides[0]:g}x{sides[1]:g} pixels, focal length {focal_px[0]:g}: correct it")
    if not all(-side < at < 2 * side for at, side in zip(center_px, sides, strict=True)):
        raise InputError(f"{where}: its centre {center_px} is far outside the image; correct it")
    camera = Camera(round(sides[0]), round(sides[1]), focal_px, (center_px[0] - CORNER_PX, center_px[1] - CORNER_PX))
    return _with_lens(camera, content, where)


def _focal(content: Mapping[str, Any], axis: int, side: float, where: str) -> float:
    """Focal length along an axis in pixels, from the angle of view where that is given instead; 0 where neither is."""
    key = "xy"[axis]
    if focal_px := number(content, f"fl_{key}", where):
        return focal_px
    # Of an angle beside a focal length instant-ngp says only the same again.
    angle_rad = number(content, f"camera_angle_{key}", where) if content.get("fl_x") is None else None
    if angle_rad is None:
        return 0.0
    if not 0 < angle_rad < math.pi:
        raise InputError(f"{where}: camera_angle_{key} is {angle_rad:g}, not an angle of view in radians; correct it")
    return side / 2 / math.tan(angle_rad / 2)


def _with_lens(camera: Camera, content: Mapping[str, Any], where: str) -> Camera:
    coefficients = [number(content, key, where) or 0.0 for key in _COEFFICIENTS]
    k1, k2, k3, k4, p1, p2 = coefficients
    is_fisheye = bool(content.get("is_fisheye"))
    model = content.get("camera_model") or (
        "OPENCV_FISHEYE" if is_fisheye else "OPENCV" if any(coefficients) else "PINHOLE"
    )
    if model == "OPENCV_FISHEYE":
        fisheye = FisheyeModel(camera.focal_px, camera.center_px, (k1, k2, k3, k4))
        return replace(camera, distorted=fisheye, model=model)
    if model not in _BROWN:
        raise InputError(
            f"{where}: camera_model {str(model)[:40]!r} is not read, only {', '.join(_BROWN)} and OPENCV_FISHEYE; "
            "make pinhole images of it first"
        )
    if k4:
        raise InputError(
            f"{where}: k4 is {k4:g}, which OpenCV's lens does not have; give camera_model OPENCV_FISHEYE, or 0"
        )
    if not any(coefficients):
        return replace(camera, model=model)
    lens = OpenCVModel(camera.focal_px, camera.center_px, (k1, k2, p1, p2, k3))
    return replace(camera, distorted=lens, model=model)


def first_size(images: Sequence[Path]) -> tuple[int, int]:
    """Width and height of the first image that can be decoded, as its file stores it.

    Raises:
        InputError: where none can be.
    """
    reasons = []
    for path in images:
        try:
            return stored_size(path)
        except InputError as error:
            reasons.append(str(error))
    raise InputError(f"{reasons[0]} (neither it nor any other of {len(images)} images can be decoded)")


def _summary(cameras: Mapping[str, Camera]) -> str:
    first = next(iter(cameras.values()))
    return f"{len(cameras)}, {first.model}; the centre of the top-left pixel was (0.5, 0.5), and is (0, 0)"
