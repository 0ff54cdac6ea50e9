"""TUM RGB-D recordings, and TUM trajectories beside an image folder.

A trajectory is lines ``timestamp tx ty tz qx qy qz qw``: seconds, position of the colour camera's optical centre in the
world and its orientation there (camera-to-world, scalar **last**), metres in the benchmark; ``rgb.txt`` is lines
``timestamp file``. Images and poses are associated by the nearest time stamps, within 0.02 s. Source: "File Formats" of
the TUM RGB-D benchmark (Sturm et al. 2012, cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats) and its tool
``associate.py``; camera axes are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.images import PICTURES, pictures
from mambaloc.importing.capture import Capture, Unit
from mambaloc.importing.formats.builder import Posed, build_capture, from_quaternions
from mambaloc.importing.formats.parsing import (
    Table,
    as_numbers,
    first_with_pictures,
    folder_name,
    inside,
    read_lines,
    read_table,
)

FARTHEST_S = 0.02
"""Time stamps that differ by more are not associated: the default of ``associate.py``."""

_ROW = "timestamp tx ty tz qx qy qz qw"
_TRAJECTORIES = ("groundtruth.txt", "trajectory.txt", "CameraTrajectory.txt", "KeyFrameTrajectory.txt")
_IMAGE_FOLDERS = ("rgb", "color", "images", "image", "frames", ".")


def is_tum_rgbd(source: Path) -> bool:
    """Whether a folder is a TUM RGB-D recording."""
    return (source / "rgb.txt").is_file() and (source / "groundtruth.txt").is_file()


def read_tum_rgbd(source: Path) -> Capture:
    """Read a recording's ``rgb.txt`` and ``groundtruth.txt``.

    Raises:
        InputError: for a file that is missing or damaged, or where nothing can be associated.
    """
    listing, table = source / "rgb.txt", _read_trajectory(source / "groundtruth.txt")
    images, stamps, missing = [], [], []
    for line, words in read_lines(listing, "a line each: timestamp file"):
        stamp = as_numbers(words[:1])
        if len(words) != 2 or stamp is None or not np.isfinite(stamp).all():
            raise InputError(f"{listing}, line {line}: is no line 'timestamp file'; correct or remove it")
        image = inside(source, words[1], f"{listing}, line {line}")
        if image.is_file():
            images.append(image)
            stamps.append(float(stamp[0]))
        else:
            missing.append(words[1])
    if not images:
        raise InputError(f"{listing}: names no image that is there, of {len(missing)}; add them")
    pairs = _by_time(listing, np.array(stamps), table)
    how = f"nearest time stamps, within {FARTHEST_S} s"
    beside = [*images, *pictures(source / "rgb")]
    return _capture("tum_rgbd", source, table, [(images[i], j, stamps[i]) for i, j in pairs], how, missing, beside)


def is_tum(source: Path) -> bool:
    """Whether a source is, or a folder holds, a TUM trajectory by its name."""
    return bool(_trajectories(source))


def read_tum(source: Path) -> Capture:
    """Read a trajectory beside an image folder, whose files are named by time stamps or by its first column.

    Raises:
        InputError: for a file that is missing or damaged, or where names do not tell which pose is which image's.
    """
    found = _trajectories(source) or [source]
    if len(found) > 1:
        raise InputError(f"{source}: holds {' and '.join(path.name for path in found)}; give the one to read")
    table = _read_trajectory(found[0])
    images = pictures(first_with_pictures([found[0].parent / name for name in _IMAGE_FOLDERS]))
    pairs, missing = _by_name(images, table)
    how = "the trajectory's first column names the images"
    stamps = _stamps(images)
    if not pairs and stamps is None:
        raise InputError(
            f"{table.path}: does not tell which pose is which image's: {images[0].name!r} is neither a time stamp such "
            f"as 1305031102.175304.png, nor in its first column; write lines 'timestamp file' to "
            f"{table.path.with_name('rgb.txt')} and call the trajectory groundtruth.txt"
        )
    if not pairs and stamps is not None:
        pairs, how = _by_time(images[0].parent, stamps, table), f"nearest time stamps, within {FARTHEST_S} s"
    rows = [(images[i], j, None if stamps is None else float(stamps[i])) for i, j in pairs]
    return _capture("tum", found[0].parent, table, rows, how, missing, images)


def associated(first_s: NDArray[np.float64], second_s: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Pair each of the first time stamps with the nearest of the second, within 0.02 s.

    Where one is nearest to several, the closest of them alone keeps it: no pose is given to two images.

    Returns:
        Pairs of indices, in the order of the first.
    """
    order = np.argsort(second_s, kind="stable")
    ordered_s = second_s[order]
    after = np.searchsorted(ordered_s, first_s).clip(0, len(order) - 1)
    before = (after - 1).clip(0)
    nearest = np.where(first_s - ordered_s[before] <= np.abs(ordered_s[after] - first_s), before, after)
    apart_s = np.abs(ordered_s[nearest] - first_s)
    closest_first = np.argsort(apart_s, kind="stable")
    _, kept = np.unique(nearest[closest_first], return_index=True)
    rows = np.sort(closest_first[kept])
    return [(i, int(order[nearest[i]])) for i in rows[apart_s[rows] < FARTHEST_S].tolist()]


def _read_trajectory(path: Path) -> Table:
    return read_table(path, 7, _ROW, named=True)


def _trajectories(source: Path) -> list[Path]:
    paths = [source] if source.is_file() else [source / name for name in _TRAJECTORIES]
    paths += sorted(source.glob("*.tum")) if source.is_dir() else []
    return [path for path in paths if path.is_file() and (path.suffix == ".tum" or path.name in _TRAJECTORIES)]


def _by_time(named: Path, stamps: NDArray[np.float64], table: Table) -> list[tuple[int, int]]:
    poses_s = as_numbers(table.words)
    if poses_s is None or not np.isfinite(poses_s).all():
        raise InputError(f"{table.path}: its first column is no time stamp in seconds throughout; correct it")
    pairs = associated(stamps, poses_s)
    if not pairs:
        raise InputError(
            f"{table.path}: none of {len(poses_s)} poses ({poses_s.min():.2f} to {poses_s.max():.2f} s) is within "
            f"{FARTHEST_S} s of an image of {named} ({stamps.min():.2f} to {stamps.max():.2f} s); give one recording's"
        )
    return pairs


def _by_name(images: Sequence[Path], table: Table) -> tuple[list[tuple[int, int]], list[str]]:
    """Pair images with rows that name them, and the names that are left; nothing where only some meet, by chance."""
    rows = {_plain(word): row for row, word in enumerate(table.words)}
    pairs = [(i, rows[_plain(image.name)]) for i, image in enumerate(images) if _plain(image.name) in rows]
    if len(pairs) not in (len(images), len(table.words)):
        return [], []
    unused = sorted(set(range(len(table.words))) - {row for _, row in pairs})
    return pairs, [table.words[row] for row in unused]


def _plain(name: str) -> str:
    """An image's name without folder, suffix and leading zeros, or a whole number without ``.0``."""
    path = PurePosixPath(name)
    stem = path.stem if path.suffix.lower() in PICTURES else path.name
    whole = stem.removesuffix(".0")
    return whole.lstrip("0") or "0" if whole.isascii() and whole.isdecimal() else stem


def _stamps(images: Sequence[Path]) -> NDArray[np.float64] | None:
    """Seconds that image files are named by, if they are; whole numbers could as well count frames."""
    stamps = as_numbers([image.stem for image in images])
    has_fractions = all("." in image.stem for image in images)
    return stamps if stamps is not None and has_fractions and np.isfinite(stamps).all() else None


def _capture(
    kind: str,
    source: Path,
    table: Table,
    rows: list[tuple[Path, int, float | None]],
    how: str,
    missing: Sequence[str],
    beside: Sequence[Path],
) -> Capture:
    """Images with the row of their pose and their time, as a capture."""
    quaternion = np.roll(table.numbers[:, 3:], 1, axis=1)
    world_from_cam, mended = from_quaternions(table.numbers[:, :3], quaternion, table.where)
    unit: Unit = "metre" if kind == "tum_rgbd" else "unknown"
    choices = {
        "axes": "OpenCV camera axes, as the format has them",
        "direction": "camera-to-world, scalar last, as the format has them",
        "scale": "metres, as the benchmark has them" if unit == "metre" else "unknown: a trajectory does not tell",
        "origin": "kept",
        "association": how,
    }
    if mended:
        choices["quaternions"] = f"{mended} of {len(table.lines)} were not of unit length, and made so"
    if all(time_s is not None for _, _, time_s in rows):
        rows = sorted(rows, key=lambda row: row[2] or 0.0)
    sequence = folder_name(source)
    posed = [Posed(image, sequence, world_from_cam[row], time_s=time_s) for image, row, time_s in rows]
    return build_capture(kind, source, posed, unit=unit, choices=choices, missing=missing, beside=beside)
