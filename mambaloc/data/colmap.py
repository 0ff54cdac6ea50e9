"""COLMAP models, text or binary, loaded by pycolmap once their files hold what they count."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.colmap_text import count_images, readable
from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX

COLMAP_FOLDERS = ("sparse/0", "sparse")
"""Where a scene's model lies, in the order it is looked for."""

# A record of a binary file: so many bytes, a name that ends in 0 or none, a count, and so many bytes an item.
_RECORDS = {
    "images.bin": (64, True, "<Q", 24),
    "points3D.bin": (43, False, "<Q", 8),
    "frames.bin": (64, False, "<I", 16),
}
_CAMERA = 24  # bytes, of a record in cameras.bin before its parameters
_SENSOR, _POSE = 8, 56  # bytes, of a record in rigs.bin


def colmap_models(folder: Path, roots: Sequence[str] = ("sparse",)) -> list[Path]:
    """The folders of a scene's COLMAP models, the one with most images first.

    COLMAP leaves as many as it finds groups of images that it cannot connect, and the first need not be the largest.

    Args:
        folder: the scene's.
        roots: where models lie, themselves or in numbered folders; the first that has any is looked at.
    """
    for root in roots:
        numbered = sorted((path for path in (folder / root).glob("*") if path.name.isdecimal()), key=_by_number)
        found = [model for model in (*numbered, folder / root) if _has_images(model)]
        if found:
            return sorted(found, key=count_images, reverse=True) if len(found) > 1 else found
    return []


def colmap_folder(folder: Path) -> Path | None:
    """The folder of a scene's COLMAP model, the fullest of several, if it has one."""
    return next(iter(colmap_models(folder)), None)


def _by_number(path: Path) -> int:
    return int(path.name[:18])


def _has_images(model: Path) -> bool:
    return any((model / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))


def load_colmap(path: Path) -> Any:
    """Load a model's folder as a ``pycolmap.Reconstruction``.

    Raises:
        InputError: without pycolmap, or for a model that is damaged.
    """
    pycolmap = import_pycolmap(path)
    for name in ("cameras.bin", "images.bin", "points3D.bin", "frames.bin", "rigs.bin"):  # all before COLMAP reads any
        if (path / name).is_file() and not _is_complete(name, (path / name).read_bytes()):
            raise InputError(f"{path / name}: is truncated; export the model again")
    with readable(path) as (folder, names):
        try:
            model = pycolmap.Reconstruction(folder)
            for number, name in names.items():
                model.images[number].name = name
            [image.name for image in model.images.values()]  # each must be UTF-8
        except Exception as error:  # whatever COLMAP's C++ throws at a damaged file
            lines = str(error).strip().splitlines()[-1:] or [type(error).__name__]
            reason = lines[0].replace(str(folder), str(path))[:200]
            message = f"{path}: is not a COLMAP model that pycolmap can read ({reason}); export it again or remove it"
            raise InputError(message) from None
    return model


def import_pycolmap(needed_by: Path) -> Any:
    """The module pycolmap.

    Raises:
        InputError: where it is not installed.
    """
    try:
        import pycolmap
    except ImportError:
        raise InputError(f"{needed_by}: needs pycolmap. Run pip install 'mambaloc[colmap]'.") from None
    return pycolmap


def is_sound(camera: Any) -> bool:
    """Whether a ``pycolmap.Camera`` has a size and finite, positive focal lengths."""
    sizes = (camera.width, camera.height, camera.focal_length_x, camera.focal_length_y)
    return bool(np.isfinite(camera.params).all()) and min(sizes) > 0


def pinhole_of(camera: Any, size_px: tuple[int, int]) -> NDArray[np.float64]:
    """Intrinsics (3, 3) of a sound ``pycolmap.Camera`` in pixels of images of a size (width, height).

    Of a distorted camera model the pinhole part is taken. COLMAP counts from the corner of the top-left pixel.
    """
    scale_x, scale_y = size_px[0] / camera.width, size_px[1] / camera.height
    center = (camera.principal_point_x * scale_x - CORNER_PX, camera.principal_point_y * scale_y - CORNER_PX)
    focal = (camera.focal_length_x * scale_x, camera.focal_length_y * scale_y)
    return np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])


def _is_complete(name: str, data: bytes) -> bool:
    """Whether a file holds what it counts: COLMAP believes a count, and fills the memory."""
    try:
        (records,) = struct.unpack_from("<Q", data)
        at = 8
        for _ in range(records):
            at = _ENDS[name](data, at) if name in _ENDS else _end_of_record(data, at, *_RECORDS[name])
    except (struct.error, ValueError, OverflowError):
        return False
    return at <= len(data)


def _end_of_record(data: bytes, at: int, fixed: int, is_named: bool, count: str, item: int) -> int:
    at += fixed
    at = data.index(b"\0", at) + 1 if is_named else at
    (items,) = struct.unpack_from(count, data, at)
    return at + struct.calcsize(count) + item * int(items)


def _end_of_camera(data: bytes, at: int) -> int:
    """The camera's number, its model, its size, and as many parameters as pycolmap says that the model has."""
    import pycolmap

    (model,) = struct.unpack_from("<4xi", data, at)
    example = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    return at + _CAMERA + 8 * len(example.params)


def _end_of_rig(data: bytes, at: int) -> int:
    """The rig's number, how many sensors it has, the first one, and each other with its pose or without."""
    (sensors,) = struct.unpack_from("<4xI", data, at)
    at += 8 + _SENSOR * min(1, sensors)
    for _ in range(1, sensors):
        (has_pose,) = struct.unpack_from("<?", data, at + _SENSOR)
        at += _SENSOR + 1 + _POSE * has_pose
    return at


_ENDS = {"cameras.bin": _end_of_camera, "rigs.bin": _end_of_rig}
