"""Recordings of Stray Scanner, an app for phones with LiDAR: a video, and ARKit's pose of each of its frames.

``odometry.csv`` has a header and a row a frame, ``timestamp, frame, x, y, z, qx, qy, qz, qw`` in seconds and metres,
and in newer versions ``fx, fy, cx, cy``. ``camera_matrix.csv`` is K, 3x3, of the video's frames. ``rgb.mp4`` is the
video, ``depth/NNNNNN.png`` a frame's depth in millimetres of 16 bits, with the same field of view, and
``confidence/NNNNNN.png`` how sure ARKit is of each of its pixels: 0, 1 or 2. Source:
``docs/format.md`` of github.com/strayrobots/scanner. The app turns ARKit's camera axes to OpenCV's before it writes a
quaternion, which the format does not say: ``OdometryEncoder.swift`` there, and its author's answer in issue 11. The
principal point is ARKit's, counted from the corner of the top-left pixel.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mambaloc.data.depth_frames import read_depth_mm
from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX, stored_size
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.formats.arkit import distinguish_cameras
from mambaloc.importing.formats.builder import Matrices, Posed, build_capture, from_quaternions, pinhole
from mambaloc.importing.formats.parsing import Table, as_numbers, folder_name, read_text
from mambaloc.importing.video import chosen_as_stored

_VIDEO, _ODOMETRY, _MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
_POSE = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_SENSOR = ("depth", "confidence")
_LENS = ("fx", "fy", "cx", "cy")
_CHOICES = {
    "axes": "OpenCV camera axes, which the app writes; the world is ARKit's",
    "direction": "camera-to-world, as the format has it",
    "scale": "metres, as ARKit has them",
    "origin": "kept: where the recording began",
}


def is_stray_scanner(source: Path) -> bool:
    """Whether a folder is a recording of Stray Scanner."""
    return all((source / name).is_file() for name in (_VIDEO, _ODOMETRY, _MATRIX))


def read_stray_scanner(source: Path) -> Capture:
    """Read poses, and choose frames of the video for sharpness and movement, which are kept in the user's cache.

    Raises:
        InputError: for a file that is missing or damaged, or a video without a posed frame.
    """
    table = _odometry(source / _ODOMETRY)
    numbers = [_frame_number(table, row) for row in range(len(table.lines))]
    quaternion = table.numbers[:, [8, 5, 6, 7]]
    checked = from_quaternions(table.numbers[:, 2:5], quaternion, table.where)
    video = chosen_as_stored(source / _VIDEO)
    present = [row for row, number in enumerate(numbers) if number in video.images]
    if not present:
        raise InputError(
            f"{source / _ODOMETRY}: has no pose of a frame that was chosen of {_VIDEO}, which has {video.read} frames. "
            "Give the video and the poses of one recording."
        )
    images = [video.images[numbers[row]] for row in present]
    size = stored_size(images[0])
    matrix = _camera_matrix(source / _MATRIX)
    names, cameras = distinguish_cameras([_camera(table, row, size, matrix, source) for row in present])
    depth, confidence = (_files_of(source / kind, [numbers[row] for row in present]) for kind in _SENSOR)
    posed = [
        Posed(
            image,
            folder_name(source),
            checked[row],
            name,
            table.numbers[row, 0],
            depth=measured,
            confidence=sure,
        )
        for image, row, name, measured, sure in zip(images, present, names, depth, confidence, strict=True)
    ]
    return build_capture(
        "stray_scanner",
        source,
        posed,
        unit="metre",
        choices={
            **_CHOICES,
            **checked.choices,
            **_depth_choice(depth, confidence),
            "frames": f"{len(video.images)} of {video.read}, by sharpness and movement",
        },
        cameras=cameras,
        missing=[f"{_VIDEO}, frame {number}" for number in numbers if number >= video.read],
        beside=video.images.values(),
        depth_camera=_depth_camera([each.depth for each in posed if each.depth is not None], size, matrix),
    )


def _files_of(folder: Path, numbers: Sequence[int]) -> list[Path | None]:
    """The PNG of each frame; None without one."""
    files = [folder / f"{number:06d}.png" for number in numbers]
    return [file if file.is_file() else None for file in files]


def _depth_choice(depth: Sequence[Path | None], confidence: Sequence[Path | None]) -> dict[str, str]:
    """What was decided of depth, by name; empty without depth."""
    count = sum(file is not None for file in depth)
    sure = sum(None not in pair for pair in zip(depth, confidence, strict=True))
    if not count:
        return {}
    rule = f"pixels of confidence 0, of 0 to 2, are left out in {sure} of {count} frames" if sure else "all pixels"
    return {"depth": rule}


def _odometry(path: Path) -> Table:
    """Rows by their columns' names; ``numbers`` are those of a pose, and of a lens where all rows have one."""
    lines = read_text(path, f"a header and rows {', '.join(_POSE)}").splitlines()
    header = [name.strip() for name in lines[0].split(",")] if lines else []
    absent = [name for name in _POSE if name not in header]
    if absent:
        raise InputError(f"{path}: its first line names no column {absent[0]!r}; export the recording again")
    rows = [(at, row) for at, row in enumerate(csv.reader(lines), start=1) if at > 1 and row]
    columns = [header.index(name) for name in _POSE]
    if set(_LENS) <= set(header):
        lens = [header.index(name) for name in _LENS]
        has_lens = all(len(row) > max(lens) and all(row[at].strip() for at in lens) for _, row in rows)
        columns += lens if has_lens else []
    numbers = np.empty((len(rows), len(columns)))
    for at, (line, row) in enumerate(rows):
        values = as_numbers([row[column] for column in columns]) if len(row) > max(columns) else None
        if values is None or not np.isfinite(values[:2]).all():
            raise InputError(f"{path}, line {line}: is not a row {', '.join(_POSE)} of numbers; correct or remove it")
        numbers[at] = values
    if not rows:
        raise InputError(f"{path}: has no row below its header; record again")
    return Table(path, tuple(line for line, _ in rows), tuple(row[0] for _, row in rows), numbers)


def _frame_number(table: Table, row: int) -> int:
    number = table.numbers[row, 1]
    if number < 0 or number != int(number):
        raise InputError(f"{table.where(row)}: {number:g} is not a frame's number; correct or remove the row")
    return int(number)


def _camera_matrix(path: Path) -> Matrices:
    """K (3, 3), the principal point counted from the corner."""
    rows = [line.split(",") for line in read_text(path, "a 3x3 matrix").splitlines() if line.strip()]
    values = as_numbers([word for row in rows for word in row])
    if values is None or [len(row) for row in rows] != [3, 3, 3]:
        raise InputError(f"{path}: is not a 3x3 matrix of numbers between commas; export the recording again")
    return values.reshape(3, 3)


def _camera(table: Table, row: int, size: tuple[int, int], matrix: Matrices, source: Path) -> Camera:
    """A frame's own lens where the recording has it, or else that of all."""
    own = table.numbers[row, len(_POSE) :].tolist()
    fx, fy, cx, cy = own or matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    where = table.where(row) if own else source / _MATRIX
    return pinhole(size, (fx, fy), (cx - CORNER_PX, cy - CORNER_PX), where)


def _depth_camera(files: Sequence[Path], size: tuple[int, int], matrix: Matrices) -> Matrices | None:
    """K of depth frames, which see what the video's frames see; None without depth."""
    if not files:
        return None
    height, width = read_depth_mm(files[0]).shape
    scaled = np.diag([width / size[0], height / size[1], 1.0]) @ matrix
    scaled[:2, 2] -= CORNER_PX
    return scaled
