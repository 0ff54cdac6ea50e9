"""TUM RGB-D recordings, and TUM trajectories beside an image folder.

A trajectory is lines ``timestamp tx ty tz qx qy qz qw``: position of the colour camera's optical centre in the world
and its orientation there (camera-to-world, scalar **last** unless the file's header puts it first), in seconds and
metres in the benchmark; ``rgb.txt`` is lines ``timestamp file``. Images and poses are associated by
:mod:`mambaloc.importing.formats.timing`. Source: "File Formats" of the TUM RGB-D benchmark (Sturm et al. 2012,
cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats) and its tool ``associate.py``; camera axes are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import list_images
from mambaloc.importing.capture import Capture, Unit
from mambaloc.importing.formats.builder import Posed, build_capture, from_quaternions
from mambaloc.importing.formats.column_names import scale_of
from mambaloc.importing.formats.finding import find_images
from mambaloc.importing.formats.parsing import (
    Table,
    first_with_images,
    folder_name,
    images_in_same_folders,
    only_file,
    read_lines,
)
from mambaloc.importing.formats.pose_rows import IMAGE_FOLDERS, Layout, layout_of, pose_files, read_rows
from mambaloc.importing.formats.timing import by_time, pair, stamps_of

_ROW = "timestamp tx ty tz qx qy qz qw"
_TRAJECTORIES = ("groundtruth.txt", "trajectory.txt", "CameraTrajectory.txt", "KeyFrameTrajectory.txt")


def is_tum_rgbd(source: Path) -> bool:
    """Whether a folder is a TUM RGB-D recording."""
    return (source / "rgb.txt").is_file() and (source / "groundtruth.txt").is_file()


def read_tum_rgbd(source: Path, images: Path | None = None) -> Capture:
    """Read a recording's ``rgb.txt`` and ``groundtruth.txt``.

    Args:
        source: the recording's folder.
        images: the folder of the images that ``rgb.txt`` names; the recording's own unless given.

    Raises:
        InputError: for a file that is missing or damaged, or where nothing can be associated.
    """
    listing, (table, layout) = source / "rgb.txt", _read_trajectory(source / "groundtruth.txt")
    named, words_of = [], []
    for line, words in read_lines(listing, "a line each: timestamp file"):
        if len(words) != 2 or stamps_of(words[:1]) is None:
            raise InputError(f"{listing}, line {line}: is not a line 'timestamp file'; correct or remove it")
        named.append((words[1], f"{listing}, line {line}"))
        words_of.append(words[0])
    if not named:
        raise InputError(f"{listing}: names no image; add lines 'timestamp file'")
    found = find_images(images or source, named)
    there = [row for row, file in enumerate(found.files) if file not in found.missing]
    stamps = stamps_of([words_of[row] for row in there])
    if stamps is None:
        raise InputError(f"{listing}: has time stamps in an unknown unit; correct them")
    pairs, how = by_time(listing, stamps, table.words, table.path)
    how = "; ".join(filter(None, (how, found.elsewhere)))
    missing = [name for (name, _), file in zip(named, found.files, strict=True) if file in found.missing]
    beside = images_in_same_folders(found.files[row] for row in there)
    rows = [(found.files[there[i]], j, float(stamps.seconds[i])) for i, j in pairs]
    return _capture("tum_rgbd", source, (table, layout), rows, how, missing, beside)


def is_tum(source: Path) -> bool:
    """Whether a source is, or a folder holds, a TUM trajectory, by its lines or its name."""
    return bool(_trajectories(source))


def read_tum(source: Path) -> Capture:
    """Read a trajectory beside an image folder, whose files are named by time stamps or by its first column.

    Raises:
        InputError: for a file that is missing or damaged, or where names do not match poses to images.
    """
    path = only_file(_trajectories(source), source)
    table, layout = _read_trajectory(path)
    images = list_images(first_with_images([path.parent / name for name in IMAGE_FOLDERS]))
    pairing = pair(images, table.words, table.path)
    return _capture("tum", path.parent, (table, layout), pairing.frames, pairing.how, pairing.missing, images)


def _read_trajectory(path: Path) -> tuple[Table, Layout]:
    layout = layout_of(path) or Layout(is_named=True, is_text=False, count=7)
    if (layout.is_named, layout.count, layout.quaternion) != (True, 7, 3):
        raise InputError(
            f"{path}: does not have lines {_ROW!r}. Omit --format: the format is found by the file's lines."
        )
    if layout.is_unclear:
        raise InputError(
            f"{path}: its header does not say where the scalar of the quaternions is. Name the columns in it: {_ROW}, "
            "or qw before qx if the scalar comes first."
        )
    return read_rows(path, layout, _ROW), layout


def _trajectories(source: Path) -> list[Path]:
    """Files of time stamps and seven numbers; those of a trajectory's name where their lines are ambiguous."""
    if source.is_file():
        return [source] if _is_trajectory(source, layout_of(source)) else []
    named = [source / name for name in _TRAJECTORIES] + (sorted(source.glob("*.tum")) if source.is_dir() else [])
    known = [path for path in named if path.is_file() and _is_trajectory(path, layout_of(path))]
    return known or [path for path, layout in pose_files(source).items() if _is_trajectory(path, layout)]


def _is_trajectory(path: Path, layout: Layout | None) -> bool:
    if path.suffix == ".tum" or path.name in _TRAJECTORIES:
        return layout is None or layout.count == 7
    if layout is None:
        return False
    return (layout.is_named, layout.is_text, layout.count, layout.quaternion) == (True, False, 7, 3)


def _capture(
    kind: str,
    source: Path,
    trajectory: tuple[Table, Layout],
    rows: Sequence[tuple[Path, int, float | None]],
    how: str,
    missing: Sequence[str],
    beside: Sequence[Path],
) -> Capture:
    """Images with the row of their pose and their time, as a capture."""
    table, layout = trajectory
    scalar, scalar_source = layout.scalar or "last", "its header says" if layout.scalar else "the format has them"
    quaternion = table.numbers[:, 3:] if scalar == "first" else np.roll(table.numbers[:, 3:], 1, axis=1)
    checked = from_quaternions(table.numbers[:, :3], quaternion, table.where)
    unit: Unit = "metre" if kind == "tum_rgbd" else "unknown"
    length_m = layout.metres_per_unit(table.path)
    known = "metres, as the benchmark has them" if unit == "metre" else "unknown: a trajectory does not state it"
    choices = {
        "axes": "OpenCV camera axes, as the format has them",
        "direction": f"camera-to-world, scalar {scalar}, as {scalar_source}",
        "scale": scale_of(length_m, known),
        "origin": "kept",
        "association": how,
        **checked.choices,
    }
    if all(time_s is not None for _, _, time_s in rows):
        rows = sorted(rows, key=lambda row: row[2] or 0.0)
    sequence = folder_name(source)
    posed = [Posed(image, sequence, checked[row], time_s=time_s) for image, row, time_s in rows]
    return build_capture(
        kind, source, posed, unit=unit, choices=choices, missing=missing, beside=beside, metres_per_unit=length_m
    )
