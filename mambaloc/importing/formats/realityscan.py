"""Cameras that RealityScan and RealityCapture export as CSV ("Internal/External camera parameters").

A line names the columns ``#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2``, or, in newer versions, ``yaw``,
``f_35mm``, ``px_norm`` and ``py_norm``; a row is an image. Position is the camera's centre. Angles are in degrees:
``world_from_cam = Rz(-heading) Rx(pitch) Ry(roll)`` in OpenGL's camera axes, so that zeros look down with north up. The
focal length is for an image 36 mm long, the principal point a share of the longer side from the image's middle,
right and down. The lens is that of :mod:`mambaloc.importing.formats.photogrammetric_lens`, with t1 and t2 as p1 and p2.
The world is that which was asked for in the export, and its unit is not in the file. Source: the export formats that
ship with RealityScan 2.2 (``calibration.xml``: ``$(f*36)``, ``$(px*scale+width*0.5)``, OpenCV's p1 and p2 as t2 and t1)
as readers of it quote them; ``realitycapture_utils.py`` of nerfstudio (angles) and AliceVision's importer of XMP
(principal point). nerfstudio divides px and py by 36 and takes t1 for OpenCV's p1, which its own comments call a guess.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX, stored_size
from mambaloc.importing.capture import OPENCV_FROM_OPENGL, Camera, Capture
from mambaloc.importing.formats.builder import Matrices, Posed, build_capture, pinhole, validate_se3
from mambaloc.importing.formats.finding import find_images
from mambaloc.importing.formats.parsing import as_numbers, folder_name, images_in_same_folders, only_file, read_text
from mambaloc.importing.formats.photogrammetric_lens import photogrammetric_lens
from mambaloc.runtime.rotations import rigid_transforms
from mambaloc.text import natural, open_text

_POSE = ("x", "y", "alt", "heading", "pitch", "roll", "f")
_LENS = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
"""Columns that may be missing from an export; they are then zeros."""
_NEWER = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
_FULL_FRAME_MM = 36.0
_BEFORE_HEADER = 5  # lines, as the number of cameras
_CHOICES = {
    "axes": "OpenGL's (x right, y up, z back), turned to OpenCV's; angles turn about z, x and y",
    "direction": "camera to world, as the format has it",
    "scale": "unknown: the export's coordinate system is not in the file",
    "origin": "kept",
    "order": "by file name, its numbers as numbers, since the format has no times",
}

Row = tuple[int, str, Matrices]
"""A line's number, the image's name, and numbers by :data:`_POSE` and :data:`_LENS`."""


def is_realityscan(source: Path) -> bool:
    """Whether a source is such a table, or a folder that holds one, by the names of its columns."""
    return bool(_files(source))


def read_realityscan(source: Path, images: Path | None = None) -> Capture:
    """Read a table; images with the same numbers have one camera.

    Args:
        source: the table, or its folder.
        images: the folder of the images; found below the table's by their names unless given.

    Raises:
        InputError: for a table that is malformed, a camera that cannot be one, or where no image is there.
    """
    path = only_file(_files(source), source)
    rows = _rows(path)
    folder = images or path.parent
    found = find_images(folder, [(name, f"{path}, line {line}") for line, name, _ in rows])
    there = [row for row, file in enumerate(found.files) if file not in found.missing]
    table = np.array([numbers for _, _, numbers in rows])
    checked = validate_se3(_world_from_cam(table), lambda row: f"{path}, line {rows[row][0]}")
    name_of: dict[tuple[float, ...], str] = {}
    cameras: dict[str, Camera] = {}
    posed = []
    for row, size in zip(there, _sizes([found.files[row] for row in there]), strict=True):
        lens = (*size, *table[row, len(_POSE) - 1 :].tolist())
        name = name_of.setdefault(lens, f"camera-{len(name_of) + 1}")
        if name not in cameras:
            cameras[name] = _camera(size, lens[2:], f"{path}, line {rows[row][0]}")
        posed.append(Posed(found.files[row], _sequence(found.files[row], folder), checked[row], name))
    return build_capture(
        "realityscan",
        path,
        sorted(posed, key=lambda each: natural(each.image)),
        unit="unknown",
        choices={**_CHOICES, **found.choices},
        cameras=cameras,
        missing=[rows[row][1] for row, file in enumerate(found.files) if file in found.missing],
        beside=images_in_same_folders(found.files[row] for row in there),
    )


def _files(source: Path) -> list[Path]:
    files = [source] if source.is_file() else sorted(source.glob("*.csv")) if source.is_dir() else []
    return [file for file in files if file.suffix.lower() == ".csv" and file.is_file() and _has_columns(file)]


def _header(line: str) -> list[str]:
    """The names of a line's columns, as older versions call them."""
    names = [name.strip().lower() for name in line.lstrip("# ").split(",")]
    return [_NEWER.get(name, name) for name in names]


def _has_columns(file: Path) -> bool:
    try:
        with open_text(file) as opened:
            lines = [line for line, _ in zip(opened, range(_BEFORE_HEADER), strict=False)]
    except OSError:
        return False
    return any({"name", *_POSE} <= set(_header(line)) for line in lines)


def _rows(path: Path) -> list[Row]:
    lines = read_text(path, "a table of cameras of RealityScan").splitlines()
    at = next((at for at, line in enumerate(lines[:_BEFORE_HEADER]) if {"name", *_POSE} <= set(_header(line))), None)
    if at is None:
        raise InputError(
            f"{path}: names no columns name, {', '.join(_POSE)}; export Internal/External camera parameters"
        )
    names = _header(lines[at])
    twice = next((name for name in names if name and names.count(name) > 1), None)
    if twice:
        raise InputError(f"{path}, line {at + 1}: names the column {twice[:40]!r} twice; remove one")
    rows = []
    for number, words in enumerate(csv.reader(lines[at + 1 :]), start=at + 2):
        if not "".join(words).strip(" #"):
            continue
        row = dict(zip(names, map(str.strip, words), strict=False))
        numbers = as_numbers([row.get(name, "nan") for name in _POSE] + [row.get(name, "0") for name in _LENS])
        if len(words) != len(names) or numbers is None:
            raise InputError(f"{path}, line {number}: is not a row of a name and numbers; correct or remove it")
        rows.append((number, row["name"], numbers))
    if not rows:
        raise InputError(f"{path}: has no row below its columns' names; align the images, and export again")
    return rows


def _world_from_cam(table: Matrices) -> Matrices:
    """Poses (N, 4, 4) of rows of numbers; NaN where a position or an angle is not finite."""
    is_lost = np.asarray(~np.isfinite(table[:, :6]).all(axis=1))
    heading, pitch, roll = np.where(is_lost[:, None], 0.0, table[:, 3:6]).T
    rotation = Rotation.from_euler("ZXY", np.stack((-heading, pitch, roll), axis=1), degrees=True).as_matrix()
    poses = rigid_transforms(rotation, table[:, :3]) @ OPENCV_FROM_OPENGL
    return np.where(is_lost[:, None, None], np.nan, poses)


def _sizes(images: Sequence[Path]) -> list[tuple[int, int]]:
    """Width and height of each image as stored; that of most for one that cannot be decoded, which is left out later.

    Raises:
        InputError: where none can be decoded.
    """
    sizes: list[tuple[int, int] | None] = []
    reasons = []
    for image in images:
        try:
            sizes.append(stored_size(image))
        except InputError as error:
            sizes.append(None)
            reasons.append(str(error))
    known = Counter(size for size in sizes if size is not None)
    if not known:
        raise InputError(f"{reasons[0]} (neither it nor any other of {len(images)} images can be decoded)")
    usual = known.most_common(1)[0][0]
    return [size or usual for size in sizes]


def _camera(size: tuple[int, int], numbers: Sequence[float], where: str) -> Camera:
    """The camera of a row's f and lens."""
    focal, px, py, *radial, t1, t2 = numbers
    longer = max(size)
    focal_px = focal / _FULL_FRAME_MM * longer
    center = [side / 2 + share * longer - CORNER_PX for side, share in zip(size, (px, py), strict=True)]
    camera = pinhole(size, (focal_px, focal_px), center, where)
    if not np.isfinite([*radial, t1, t2]).all():
        raise InputError(f"{where}: k1 to k4, t1 and t2 must be finite; export it again")
    if not any((*radial, t1, t2)):
        return camera
    lens = photogrammetric_lens(focal_px, camera.center_px, radial, (t1, t2, 0.0, 0.0))
    return replace(camera, distorted=lens, model="RealityScan's Brown")


def _sequence(image: Path, folder: Path) -> str:
    parent = image.parent.relative_to(folder)
    return parent.as_posix() if parent.name else folder_name(folder)
