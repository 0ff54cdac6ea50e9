"""KITTI odometry sequences, and a bare file of such poses beside an image folder.

A line of ``poses/NN.txt`` is the first three rows of a 4x4 matrix: the pose of the left **grey** camera, camera 0, in
the world of the sequence's first frame (camera-to-world, z forward, metres). ``calib.txt`` holds ``P0`` to ``P3``, each
``K [I | t]`` of a rectified camera, so that the colour camera 2 is camera 0 moved by ``-t``: six centimetres aside.
Source: the readme of the odometry benchmark's development kit (Geiger et al. 2012), and pykitti, which moves camera 2
the same way.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.images import list_images, stored_size
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.formats.builder import Matrices, Posed, build_capture, pinhole, validate_se3
from mambaloc.importing.formats.parsing import (
    as_numbers,
    first_with_images,
    number_of,
    only_file,
    read_lines,
    read_table,
)
from mambaloc.importing.formats.pose_lines import read_in_order
from mambaloc.importing.formats.pose_rows import Layout, layout_of, pose_files

_ROW = "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"
_FARTHEST_M = 10.0  # between two cameras of one car
_CHOICES = {
    "axes": "OpenCV camera axes, as the format has them",
    "direction": "camera-to-world, as the format has it",
    "origin": "kept: the sequence's first camera in KITTI",
}


def is_kitti(source: Path) -> bool:
    """Whether a folder is KITTI's, or one of its sequences."""
    is_root = (source / "poses").is_dir() and (source / "sequences").is_dir()
    return is_root or (source.resolve().parent.name == "sequences" and _poses_file(source).is_file())


def read_kitti(source: Path) -> Capture:
    """Read one sequence: that of the folder, or the only one with poses below it.

    Raises:
        InputError: for several sequences, whose worlds are not one, or a file that is missing or damaged.
    """
    sequence = _only_sequence(source)
    table = read_table(_poses_file(sequence), 12, _ROW, may_lack_fix=True)
    checked = validate_se3(table.numbers.reshape(-1, 3, 4), table.where)
    folder = first_with_images([sequence / "image_2", sequence / "image_0"])
    images = list_images(folder)
    camera, cam0_from_cam = _camera(sequence / "calib.txt", folder.name, images[0])
    world_from_cam = checked @ cam0_from_cam
    times = _times(sequence / "times.txt", len(checked.poses))
    numbered = {number_of(image): image for image in images}
    posed, missing = [], []
    for row in range(len(checked.poses)):
        if row in numbered:
            time_s = None if times is None else times[row]
            posed.append(Posed(numbered[row], sequence.name, world_from_cam[row], folder.name, time_s))
        else:
            missing.append(f"{folder.name}/{row:06d}{images[0].suffix}")
    moved = f"poses of camera 0, moved {np.linalg.norm(cam0_from_cam[:3, 3]) * 100:.1f} cm to {folder.name}'s"
    return build_capture(
        "kitti",
        source,
        posed,
        unit="metre",
        choices={**_CHOICES, "scale": "metres, as the benchmark has them", "camera": moved, **checked.choices},
        cameras={folder.name: camera},
        missing=missing,
        beside=images,
    )


def is_kitti_poses(source: Path) -> bool:
    """Whether a source is, or a folder holds, a bare file of twelve numbers a line, by its lines or its name."""
    return bool(_bare_files(source))


def read_kitti_poses(source: Path) -> Capture:
    """Read a pose file whose lines are those of the images beside it, in natural order of their names.

    Raises:
        InputError: for a file that is missing or damaged, or another number of images.
    """
    path = only_file(_bare_files(source), source)
    layout = layout_of(path)
    if layout is not None and (layout.is_named, layout.count) != (False, 12):
        raise InputError(
            f"{path}: does not have lines {_ROW!r}. Omit --format: the format is found by the file's lines."
        )
    return read_in_order(path, layout or Layout(False, False, 12), "kitti_poses", _CHOICES)


def _poses_file(sequence: Path) -> Path:
    sequence = sequence.resolve()
    return sequence.parent.parent / "poses" / f"{sequence.name}.txt"


def _only_sequence(source: Path) -> Path:
    if not (source / "sequences").is_dir():
        return source.resolve()
    known = sorted(path for path in (source / "sequences").iterdir() if _poses_file(path).is_file())
    if len(known) == 1:
        return known[0].resolve()
    if not known:
        raise InputError(f"{source / 'poses'}: has no NN.txt of a folder {source / 'sequences' / 'NN'}; add it")
    names = ", ".join(path.name for path in known[:12])
    raise InputError(f"{source}: holds the sequences {names}, each with a world of its own; give one, as {known[0]}")


def _camera(calibration: Path, name: str, image: Path) -> tuple[Camera, Matrices]:
    """The camera of an image folder, and its place in camera 0."""
    key = f"P{name.removeprefix('image_')}:"
    rows = [
        words[1:] for _, words in read_lines(calibration, "lines 'P0: ' to 'P3: ' of 12 numbers") if words[0] == key
    ]
    values = as_numbers(rows[0]) if len(rows) == 1 else None
    if values is None or len(values) != 12 or not np.isfinite(values).all():
        raise InputError(f"{calibration}: has no line '{key}' of 12 finite numbers; get it again")
    projection = values.reshape(3, 4)
    matrix = projection[:, :3]
    if not np.array_equal(matrix[2], (0, 0, 1)) or matrix[1, 0] != 0 or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise InputError(f"{calibration}: '{key}' is not a projection K [I | t] of a rectified camera; get it again")
    size = stored_size(image)
    camera = pinhole(size, (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]), calibration)
    cam0_from_cam = np.eye(4)
    with np.errstate(over="ignore", invalid="ignore"):
        cam0_from_cam[:3, 3] = -np.linalg.solve(matrix, projection[:, 3])
    if not np.abs(cam0_from_cam[:3, 3]).max() <= _FARTHEST_M:
        raise InputError(f"{calibration}: '{key}' is more than {_FARTHEST_M:g} m from camera 0; get it again")
    return camera, cam0_from_cam


def _times(path: Path, count: int) -> list[float] | None:
    if not path.is_file():
        return None
    times: NDArray[np.float64] = read_table(path, 1, "seconds").numbers[:, 0]
    if len(times) < count:
        raise InputError(f"{path}: has {len(times)} times for {count} poses; get it again, or remove it")
    return times.tolist()


def _bare_files(source: Path) -> list[Path]:
    if source.is_file():
        layouts = {source: layout_of(source)}
    else:
        named = [source / "poses.txt", *(sorted(source.glob("*.kitti")) if source.is_dir() else [])]
        layouts = {path: layout_of(path) for path in named if path.is_file()} or {**pose_files(source)}
    return [path for path, layout in layouts.items() if _is_bare(path, layout)]


def _is_bare(path: Path, layout: Layout | None) -> bool:
    if layout is None:
        return path.suffix == ".kitti" or path.name == "poses.txt"
    return (layout.is_named, layout.count) == (False, 12)
