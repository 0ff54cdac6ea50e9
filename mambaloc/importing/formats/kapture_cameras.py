"""Cameras of kapture's ``sensors.txt``: COLMAP's models, of which OpenCV's two lenses have all but two.

Their pixels count from the image's corner: the centre of the top-left pixel is (0.5, 0.5), as in COLMAP. Source:
``CameraType`` of github.com/naver/kapture, and ``src/colmap/sensor/models.h`` of github.com/colmap/colmap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX
from mambaloc.importing.capture import Camera
from mambaloc.importing.formats.builder import pinhole
from mambaloc.importing.formats.parsing import as_numbers
from mambaloc.runtime.camera_models import FisheyeModel, OpenCVModel

UNKNOWN = "UNKNOWN_CAMERA"
"""The model of a camera that is not calibrated."""

_FOCALS = {"SIMPLE_PINHOLE": 1, "SIMPLE_RADIAL": 1, "RADIAL": 1, "SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 1}
"""Focal lengths of models that have not two."""
_COEFFICIENTS = {
    **{"SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8},
    **{"SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2, "OPENCV_FISHEYE": 4},
}


def unique_cameras(lenses: Sequence[tuple[str, ...] | None]) -> tuple[list[str | None], dict[str, Camera]]:
    """The name of each image's camera, and cameras by name; both are empty if an image has no camera.

    Args:
        lenses: of each image, where its camera is, its model and its numbers; None for one that is not calibrated.

    Raises:
        InputError: for a model that is not read, or numbers that no camera has.
    """
    numbers: dict[tuple[str, ...], str] = {}
    names = [None if each is None else numbers.setdefault(each[1:], f"camera-{len(numbers) + 1}") for each in lenses]
    if None in names:
        return names, {}
    places = {each[1:]: each[0] for each in lenses if each is not None}
    return names, {name: _camera(params, places[params]) for params, name in numbers.items()}


def _camera(params: tuple[str, ...], where: str) -> Camera:
    model = params[0] if params else ""
    if model not in _COEFFICIENTS:
        raise InputError(
            f"{where}: camera model {model[:40]!r} is not read, only {', '.join(_COEFFICIENTS)}; export undistorted "
            "images"
        )
    values = as_numbers(params[1:])
    focals, count = _FOCALS.get(model, 2), _COEFFICIENTS[model]
    if values is None or len(values) != 4 + focals + count or not np.isfinite(values).all():
        raise InputError(f"{where}: {model} must have {4 + focals + count} finite numbers; correct it")
    size, focal, center, coefficients = np.split(values, (2, 2 + focals, 4 + focals))
    camera = pinhole(size.tolist(), (focal[0], focal[-1]), (center - CORNER_PX).tolist(), where)
    is_fisheye = model.endswith("FISHEYE")
    if not is_fisheye and not coefficients.any():
        return camera
    lens = FisheyeModel if is_fisheye else OpenCVModel
    padded = [*coefficients.tolist(), *[0.0] * (4 - count)]
    return replace(camera, distorted=lens(camera.focal_px, camera.center_px, padded), model=model)
