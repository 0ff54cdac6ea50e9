"""Tables of poses: columns by their names in the first line, in any order.

``scene,split,seq,img_path,t1,t2,t3,q1,q2,q3,q4`` is TransPoseNet's (Shavit et al. 2021,
``datasets/CameraPoseDataset.py`` of github.com/yolish/transposenet), ``scene,split,image,x,y,z,qw,qx,qy,qz`` this
project's; ``tx,ty,tz``, a ``time`` and names with units are understood, too
(:mod:`~mambaloc.importing.formats.column_names`). The position is the camera centre, in metres in these two
and an unknown unit in any other. The quaternion is what a dataset's own labels hold: in both tables of 7-Scenes
camera-to-world, of Cambridge Landmarks **world-to-camera**, and no column says which. So it is taken as
camera-to-world, unless a row is of a Cambridge scene: then the format must be named, ``csv_world_from_cam`` or
``csv_cam_from_world``. ``q1`` to ``q4`` are scalar first in TransPoseNet's table, and refused in any other. A table
without a column of images has a time, by which its rows are associated with images that are named by theirs.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import list_images
from mambaloc.importing.capture import Capture, Unit
from mambaloc.importing.formats.builder import Posed, build_capture, from_quaternions
from mambaloc.importing.formats.column_names import scale_of
from mambaloc.importing.formats.finding import Found, count_there, find_images
from mambaloc.importing.formats.parsing import (
    as_numbers,
    first_with_images,
    folder_name,
    images_in_same_folders,
    read_text,
)
from mambaloc.importing.formats.pose_rows import IMAGE_FOLDERS
from mambaloc.importing.formats.table_columns import POSITIONS, TableColumns, columns_of
from mambaloc.importing.formats.timing import pair, stamps_of

Direction = Literal["world_from_cam", "cam_from_world"]

_SPLITS = {"train": "train", "training": "train", "test": "test", "val": "val", "valid": "val", "validation": "val"}
_NO_FIX = ("", "null", "none", "na", "n/a", "-")
_CAMBRIDGE = ("KingsCollege", "OldHospital", "ShopFacade", "StMarysChurch", "GreatCourt", "Street")

Row = tuple[int, dict[str, str]]


@dataclass(frozen=True)
class _TableImages:
    """Images of a table: each with its sequence, row and time; how they were found, and those that are not there."""

    frames: list[tuple[Path, str, int, float | None]]
    how: str
    missing: list[str]


def is_csv(source: Path) -> bool:
    """Whether a source is a CSV file, or a folder that holds one."""
    return source.suffix.lower() == ".csv" or (source.is_dir() and any(source.glob("*.csv")))


def read_csv(source: Path, direction: Direction | None = None, images: Path | None = None) -> Capture:
    """Read a table of one scene, whose image files lie by it.

    Args:
        source: the table, its folder, or a scene's folder beside a table of several.
        direction: of the quaternions; camera-to-world unless the table is of a scene whose labels are not.
        images: the folder of the images; found by the table unless given.

    Raises:
        InputError: for a table that is damaged or can be read in more ways than one.
    """
    path = _table(source)
    columns, rows = _rows(path)
    rows = _of_one_scene(source, path, rows)
    _refuse_cambridge(path, rows, columns, direction)
    numbers = [_numbers(path, line, row, columns) for line, row in rows]
    table = np.array(numbers).reshape(len(rows), 7)

    def where(row: int) -> str:
        return f"{path}, line {rows[row][0]}"

    checked = from_quaternions(table[:, :3], _turned(table[:, 3:], direction), where)
    pictured = (_by_time if columns.image is None else _by_image)(path, rows, columns, images)
    posed = [
        Posed(
            image,
            sequence,
            checked[row],
            time_s=time_s,
            split=_split(path, *rows[row]),
        )
        for image, sequence, row, time_s in pictured.frames
    ]
    is_known = columns.position == POSITIONS[2] or (columns.position == POSITIONS[0] and "scene" in rows[0][1])
    known = "metres, as the datasets have them" if is_known else "unknown: the table does not state it"
    choices = {
        "axes": "OpenCV camera axes, as the datasets have them",
        "direction": "world-to-camera, as --format says" if direction == "cam_from_world" else "camera-to-world",
        "scale": scale_of(columns.metres_per_unit, known),
        "origin": "kept",
        "association": pictured.how,
        **checked.choices,
    }
    beside = images_in_same_folders(each.image for each in posed)
    missing = pictured.missing
    kind = "csv" if direction is None else f"csv_{direction}"
    unit: Unit = "metre" if is_known else "unknown"
    return build_capture(
        kind,
        path,
        posed,
        unit=unit,
        choices=choices,
        missing=missing,
        beside=beside,
        metres_per_unit=columns.metres_per_unit,
    )


def _table(source: Path) -> Path:
    if source.is_file():
        return source
    tables = sorted(source.glob("*.csv")) or sorted(source.resolve().parent.glob("*.csv"))
    if not tables:
        raise InputError(f"{source}: contains no CSV file. Give a folder that does.")
    if len(tables) > 1:
        names = ", ".join(table.name for table in tables[:8])
        raise InputError(f"{source}: has several CSV files: {names}. Give one file.")
    return tables[0]


def _rows(path: Path) -> tuple[TableColumns, list[Row]]:
    """The columns, and each row with its line."""
    text = read_text(path, "a table of poses with its columns' names in the first line")
    header = text.partition("\n")[0]
    delimiter = max(",;\t", key=header.count)
    reader = csv.reader(text.splitlines(), delimiter=delimiter)
    try:
        columns = columns_of(path, next(reader, []))
        names = columns.names
        rows = []
        for values in reader:
            if len(values) != len(names) and values:
                raise InputError(
                    f"{path}, line {reader.line_num}: has {len(values)} fields, but the first line names "
                    f"{len(names)}; correct or remove it"
                )
            if values:
                rows.append((reader.line_num, dict(zip(names, map(str.strip, values), strict=True))))
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: is not CSV ({error}); export it again") from None
    if not rows:
        raise InputError(f"{path}: has no row below its columns' names; add them")
    return columns, rows if delimiter == "," else _with_points(rows, columns)


def _with_points(rows: list[Row], columns: TableColumns) -> list[Row]:
    """Rows whose numbers have points, where no number of the poses has one, but commas, as spreadsheets write them."""
    names = (*columns.position, *columns.quaternion)
    words = [row[name] for _, row in rows for name in names]
    if any("." in word for word in words) or not any("," in word for word in words):
        return rows
    names += () if columns.time is None else (columns.time,)
    return [(line, {**row, **{name: row[name].replace(",", ".") for name in names}}) for line, row in rows]


def _of_one_scene(source: Path, path: Path, rows: list[Row]) -> list[Row]:
    scenes = list(dict.fromkeys(row.get("scene", "") for _, row in rows))
    if len(scenes) == 1:
        return rows
    scene = folder_name(source) if source.is_dir() else None
    chosen = [(line, row) for line, row in rows if row["scene"] == scene]
    if not chosen:
        raise InputError(
            f"{path}: holds the scenes {', '.join(scenes)[:200]}, each with a world of its own; give a table of one, "
            f"or its folder beside the table with --format, as {path.with_name(scenes[0])!s:.200}"
        )
    return chosen


def _refuse_cambridge(path: Path, rows: list[Row], columns: TableColumns, direction: Direction | None) -> None:
    for line, row in rows:
        first = row.get(columns.image or "", "").replace("\\", "/").partition("/")[0]
        if direction is None and any(name in (row.get("scene"), first) for name in _CAMBRIDGE):
            raise InputError(
                f"{path}, line {line}: is of Cambridge Landmarks, whose labels turn the world into the camera; say "
                "with --format csv_cam_from_world that these do, too, or with csv_world_from_cam that they do not"
            )


def _numbers(path: Path, line: int, row: dict[str, str], columns: TableColumns) -> np.ndarray:
    words = [row[name] for name in (*columns.position, *columns.quaternion)]
    values = as_numbers(["nan" if word.lower() in _NO_FIX else word for word in words])
    if values is None:
        names = ",".join((*columns.position, *columns.quaternion))
        raise InputError(f"{path}, line {line}: {names} must be numbers with points; correct or remove the row")
    return values


def _turned(quaternion: np.ndarray, direction: Direction | None) -> np.ndarray:
    return quaternion * (1, -1, -1, -1) if direction == "cam_from_world" else quaternion


def _by_image(path: Path, rows: list[Row], columns: TableColumns, given: Path | None) -> _TableImages:
    folder, found = _images(path, rows, columns, given)
    images, how = found.files, "; ".join(filter(None, ("by name", found.elsewhere)))
    stamps = None
    if columns.time is not None:
        stamps = stamps_of([row[columns.time] for _, row in rows], stated_unit=columns.time_unit)
        if stamps is None:
            line, row = next(((line, row) for line, row in rows if stamps_of([row[columns.time]]) is None), rows[0])
            time = row[columns.time][:40]
            raise InputError(f"{path}, line {line}: time {time!r} is not a number of seconds; correct it")
    frames: list[tuple[Path, str, int, float | None]] = []
    for place, ((_, row), image) in enumerate(zip(rows, images, strict=True)):
        if image.is_file():
            sequence = row[columns.sequence] if columns.sequence else image.parent.relative_to(folder).as_posix()
            name = sequence if sequence not in ("", ".") else folder_name(folder)
            frames.append((image, name, place, None if stamps is None else float(stamps.seconds[place])))
    missing = [row[str(columns.image)] for (_, row), image in zip(rows, images, strict=True) if not image.is_file()]
    return _TableImages(frames, how if stamps is None else f"{how}; timed in {stamps.unit}", missing)


def _by_time(path: Path, rows: list[Row], columns: TableColumns, given: Path | None) -> _TableImages:
    images = list_images(first_with_images([given] if given else [path.parent / name for name in IMAGE_FOLDERS]))
    pairing = pair(images, [row[str(columns.time)] for _, row in rows], path)
    name = folder_name(path.parent)
    frames = [(image, name, row, time_s) for image, row, time_s in pairing.frames]
    return _TableImages(sorted(frames, key=lambda frame: frame[3] or 0.0), pairing.how, pairing.missing)


def _images(path: Path, rows: list[Row], columns: TableColumns, given: Path | None) -> tuple[Path, Found]:
    """The folder that the table's names are relative to, and each row's file there."""
    names = [(row[str(columns.image)], row.get("scene", ""), f"{path}, line {line}") for line, row in rows]
    whole = [(name, where) for name, _, where in names]
    within = [(name.removeprefix(f"{scene}/"), where) for name, scene, where in names]
    root = given or path.parent
    candidates = [(root, whole), (root / "images", whole), (root, within)]
    folder, named = max(candidates, key=lambda each: count_there(each[0], [name for name, _ in each[1]]))
    return folder, find_images(folder, named)


def _split(path: Path, line: int, row: dict[str, str]) -> str | None:
    if "split" not in row:
        return None
    if row["split"].lower() not in _SPLITS:
        raise InputError(f"{path}, line {line}: split {row['split'][:40]!r} is not one of train, val, test; correct it")
    return _SPLITS[row["split"].lower()]
