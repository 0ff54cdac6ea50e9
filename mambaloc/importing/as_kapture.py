"""An imported scene as kapture has it, for its tools and whoever reads it: :mod:`mambaloc.importing.formats.kapture`.

The splits are kaptures of their own, ``mapping``, ``validation`` and ``query``, as kapture-localization expects them.
Positions are those of the scene's source, in the scene's unit: what was shifted towards the origin is shifted back.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.cameras import UnknownCameraError, known_cameras
from mambaloc.data.datasets.capture import CAPTURE, Row, read_rows, read_scene, read_split, world_of
from mambaloc.data.frames import BadFrames, Frames
from mambaloc.errors import InputError
from mambaloc.files import atomic_folder
from mambaloc.images import CORNER_PX, stored_size
from mambaloc.importing.formats.kapture import SPLITS
from mambaloc.runtime.rotations import conjugate, matrix_from_quaternion

_FIRST_LINE = "# kapture format: 1.1"
_US_PER_S = 10**6

Stamps = Mapping[Path, int]
Sensors = dict[tuple[str, ...], str]
"""Ids by model and numbers."""


def write_kapture(scene: Path, out: Path) -> tuple[dict[str, int], int]:
    """Write an imported scene as kaptures in a folder, which appears once it is whole.

    Images are linked to the scene's where the file system can, and copied else. Time stamps are microseconds where
    every frame has a time and no camera two frames at one; they count frames else.

    Args:
        scene: an imported scene's folder.
        out: the folder to make.

    Returns:
        How many frames each kapture has, by its folder's name, and how many the scene marks as unused.

    Raises:
        InputError: for a folder that is not a scene or marks no frame, an image whose path has a comma, or a folder
            that is there or cannot be written.
    """
    if out.exists():
        raise InputError(f"{out}: already exists; remove it, or choose another --out")
    read_scene(scene)
    rows = read_rows(scene)
    used = {name: split for name, split in SPLITS.items() if any(row.split == split for row in rows)}
    if not used:
        raise InputError(f"{scene}: has no frame for training, validation or testing; mark some in frames.csv")
    bad = next((row.image for row in rows if "," in row.image.relative_to(scene).as_posix()), None)
    if bad is not None:
        raise InputError(f"{bad}: has a comma in its path, which kapture reads as the end of a value. Rename it.")
    stamps, sensors = _stamps(rows), Sensors()
    counts = {}
    with atomic_folder(out, "choose another folder with --out") as partial:
        for name, split in used.items():
            frames = read_split(scene, split, BadFrames())
            _write_part(partial / name / "sensors", scene, frames, stamps, sensors)
            counts[name] = len(frames)
    return counts, len(rows) - sum(counts.values())


def _stamps(rows: Sequence[Row]) -> Stamps:
    """A time stamp of each image."""
    if all(row.time_s is not None for row in rows):
        stamps = {row.image: round((row.time_s or 0.0) * _US_PER_S) for row in rows}
        if len({(stamps[row.image], row.camera) for row in rows}) == len(rows):
            return stamps
    return {row.image: number for number, row in enumerate(rows)}


def _write_part(folder: Path, scene: Path, frames: Frames, stamps: Stamps, sensors: Sensors) -> None:
    """Write a split as the ``sensors`` of a kapture."""
    of_frames = _cameras(scene, frames)
    ids = [sensors.setdefault(each, f"camera-{len(sensors) + 1}") for each in of_frames]
    keys = [f"{stamps[image]}, {sensor}" for image, sensor in zip(frames.image_paths, ids, strict=True)]
    names = [image.relative_to(scene).as_posix() for image in frames.image_paths]
    cam_from_world = conjugate(frames.quaternion)
    position = world_of(scene).position_m(frames.position_m)
    translation = -np.einsum("nij,nj->ni", matrix_from_quaternion(cam_from_world), position)
    poses = np.concatenate((cam_from_world, translation), axis=1)
    cameras = [
        f"{number}, , camera, {', '.join(each)}" for each, number in dict(zip(of_frames, ids, strict=True)).items()
    ]
    records = [f"{key}, {name}" for key, name in zip(keys, names, strict=True)]
    trajectory = [f"{key}, {_joined(pose)}" for key, pose in zip(keys, poses, strict=True)]
    folder.mkdir(parents=True)
    _write(folder / "sensors.txt", "sensor_id, name, sensor_type, [sensor_params]+", cameras)
    _write(folder / "records_camera.txt", "timestamp, device_id, image_path", records)
    _write(folder / "trajectories.txt", "timestamp, device_id, qw, qx, qy, qz, tx, ty, tz", trajectory)
    for image, name in zip(frames.image_paths, names, strict=True):
        _place(image, folder / "records_data" / name)


def _cameras(scene: Path, frames: Frames) -> list[tuple[str, ...]]:
    """Model and numbers of each frame's camera; not calibrated where the scene does not give it."""
    try:
        cameras = known_cameras(CAPTURE, scene, frames)
    except UnknownCameraError:
        return [("UNKNOWN_CAMERA", *map(str, stored_size(image))) for image in frames.image_paths]
    numbers = cameras.intrinsics[:, [0, 1, 0, 1], [0, 1, 2, 2]] + (0, 0, CORNER_PX, CORNER_PX)
    return [
        ("PINHOLE", *map(str, size), *map(repr, row))
        for size, row in zip(cameras.size_px.tolist(), numbers.tolist(), strict=True)
    ]


def _joined(numbers: NDArray[np.float64]) -> str:
    return ", ".join(map(repr, numbers.tolist()))


def _write(file: Path, columns: str, rows: Iterable[str]) -> None:
    file.write_text("\n".join((_FIRST_LINE, f"# {columns}", *rows)) + "\n", encoding="utf-8")


def _place(image: Path, target: Path) -> None:
    """Give an image a second name, or a copy where the file system has no links or the folder lies on another."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(image.resolve(), target)
    except OSError:
        shutil.copyfile(image, target)
