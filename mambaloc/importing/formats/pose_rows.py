"""Text files of poses, a line each: what a line holds is found from its numbers, whatever the file is called.

A line is twelve or sixteen numbers, a matrix, or three of a position and four of a quaternion; a name, a frame's number
or a time stamp may stand before them. Twelve and sixteen are taken row by row, or column by column where only that
gives rotations. Of seven numbers, the four that have unit length in every line are the quaternion.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import IMAGE_SUFFIXES, list_images
from mambaloc.importing.formats.builder import LONGEST, SHORTEST, Matrices, is_mark
from mambaloc.importing.formats.column_names import Column, columns_in, metres_per_unit
from mambaloc.importing.formats.parsing import Table, as_numbers, read_text
from mambaloc.runtime.rotations import is_rotation

SUFFIXES = ("", ".txt", ".tum", ".kitti", ".log", ".dat", ".tsv")
IMAGE_FOLDERS = ("rgb", "color", "image_2", "image_0", "images", "image", "frames", "results", "data", ".")
"""Where images lie beside a file of poses."""
_LOOKED_AT = 200  # lines
_MIN_LINES = 2  # one may be a camera's place on its rig
_MAX_FILES = 64  # of a folder: more are labels of images
_NEARLY_ALL = 0.9  # of the lines: others may be damaged, and are refused by their line
_MAJORITY = 0.8
_TOLERANCE = 0.02  # of lengths and of entries of R R^T
_HEADERS = 3
_AFTER_IMAGE = re.compile(rf"(.*?(?:{'|'.join(map(re.escape, IMAGE_SUFFIXES))}))[\s,;]+(.+)", re.IGNORECASE)


@dataclass(frozen=True)
class Layout:
    """What a line of a file of poses holds.

    Args:
        is_named: whether a word comes before the numbers.
        is_text: whether that word is not a number.
        count: of numbers: 7, 12 or 16.
        by_column: whether a matrix is written column after column.
        quaternion: place of its first number of seven.
        header: the columns that a line above names, as many as there are; empty without such a line.
    """

    is_named: bool
    is_text: bool
    count: int
    by_column: bool = False
    quaternion: int = 3
    header: tuple[Column, ...] = ()

    @property
    def scalar(self) -> str | None:
        """Whether the header puts the quaternion's scalar ``first`` or ``last``; None where it does not say."""
        at = [place for place, column in enumerate(self._of_quaternion) if column.name.endswith("w")]
        return {0: "first", 3: "last"}.get(at[0]) if len(at) == 1 else None

    @property
    def is_unclear(self) -> bool:
        """Whether a header names the columns, but not the quaternion's in a way that is known."""
        return bool(self._of_position) and self.scalar is None

    def metres_per_unit(self, path: Path) -> float | None:
        """What the header of a file says of the positions' unit; None where it says nothing.

        Raises:
            InputError: for a unit that is not a length, or several.
        """
        return metres_per_unit(self._of_position, f"{path}: its header")

    @property
    def _start(self) -> int:
        return int(self.is_named)

    @property
    def _of_quaternion(self) -> tuple[Column, ...]:
        return self.header[self._start + self.quaternion :][:4]

    @property
    def _of_position(self) -> tuple[Column, ...]:
        """The columns of the position; empty where the header does not name them."""
        columns = self.header[self._start + (0 if self.quaternion else 4) :][:3]
        return columns if "".join(column.name[-1:] for column in columns) == "xyz" else ()


def split_line(line: str) -> tuple[str, list[str]]:
    """A line's leading word, and the words after it; an image's name may hold spaces, and be in quotes."""
    line = line.replace('"', "")
    named = _AFTER_IMAGE.fullmatch(line.strip())
    if named:
        return named[1], re.split(r"[\s,;]+", named[2].strip(" \t,;"))
    words = re.split(r"[\s,;]+", line.strip(" \t,;"))
    return words[0], words[1:]


def layout_of(path: Path) -> Layout | None:
    """What a file's lines hold; None where they are not poses, or it cannot be read."""
    try:
        lines = read_text(path, "poses").splitlines()
    except InputError:
        return None
    first, rest = lines[:_LOOKED_AT], lines[_LOOKED_AT:]  # trackers may have no pose for long
    sample = [line.strip() for line in (*first, *rest[:: 1 + len(rest) // _LOOKED_AT]) if line.strip()]
    headers = [columns_in(line.lstrip("#% ")) for line in sample if line.startswith("#")]
    rows = [split_line(line) for line in sample if not line.startswith("#")]
    start = next((at for at, (_, words) in enumerate(rows[: _HEADERS + 1]) if as_numbers(words[-7:]) is not None), None)
    if start is None or len(rows) - start < _MIN_LINES:
        return None
    if start > 0:
        headers.append(columns_in(" ".join((rows[start - 1][0], *rows[start - 1][1]))))
    return _layout(rows[start:], headers)


def _layout(rows: Sequence[tuple[str, list[str]]], headers: Sequence[tuple[Column, ...]]) -> Layout | None:
    counts = [len(words) for _, words in rows]
    after = max(set(counts), key=counts.count)
    usual = [row for row in rows if len(row[1]) == after]
    is_text = as_numbers([word for word, _ in usual]) is None
    is_named = is_text or after in (7, 12, 16)
    numbers = as_numbers([each for word, words in usual for each in (words if is_named else [word, *words])])
    count = after if is_named else after + 1
    if numbers is None or count not in (7, 12, 16) or len(usual) < _NEARLY_ALL * len(rows):
        return None
    table = numbers.reshape(len(usual), count)
    if count == 7:
        place = _place_of_quaternion(table)
        header = next((each for each in reversed(headers) if len(each) == count + is_named), ())
        return None if place is None else Layout(is_named, is_text, 7, quaternion=place, header=header)
    by_column = is_by_column(table)
    return None if by_column is None else Layout(is_named, is_text, count, by_column)


def _place_of_quaternion(table: Matrices) -> int | None:
    """Where four of seven numbers are a quaternion: of unit length in nearly all lines, or of one that is made so."""
    lengths = {place: _lengths(table, place) for place in (3, 0)}
    units = {place: int((np.abs(length - 1) < _TOLERANCE).sum()) for place, length in lengths.items()}
    place = max(units, key=lambda each: units[each])
    if units[place] >= max(_NEARLY_ALL * len(lengths[place]), 1):
        return place
    possible = [place for place, length in lengths.items() if _have_one_length(length)]
    return max(possible, key=lambda each: units[each], default=None)


def _have_one_length(length: Matrices) -> bool:
    """Whether most quaternions have the usual length, and nearly all may be made units."""
    usual = float(np.median(length)) if len(length) else 0.0
    are_usual, may_be = np.abs(length - usual) < _TOLERANCE * usual, (length >= SHORTEST) & (length <= LONGEST)
    return len(length) > 0 and bool(are_usual.mean() >= _MAJORITY and may_be.mean() >= _NEARLY_ALL)


def _lengths(table: Matrices, place: int) -> Matrices:
    """Of four numbers of each line that is not a mark."""
    quaternions = table[:, place : place + 4]
    with np.errstate(over="ignore"):
        return np.linalg.norm(quaternions[~is_mark(table, quaternions)], axis=1)


def is_by_column(table: Matrices) -> bool | None:
    """Whether transforms, (N, 12) or (N, 16), are written column after column; None if neither way gives transforms."""
    return next((by_column for by_column in (False, True) if _are_transforms(matrices_of(table, by_column))), None)


def _are_transforms(matrices: Matrices) -> bool:
    flat, rotations = matrices[:, :3].reshape(-1, 12), matrices[:, :3, :3].reshape(-1, 9)
    matrices = matrices[~is_mark(flat, rotations)]
    if not len(matrices):
        return False
    right = np.asarray(is_rotation(matrices[:, :3, :3], _TOLERANCE))
    last = np.isclose(matrices[:, 3:], (0, 0, 0, 1), rtol=0, atol=1e-6).all(axis=(1, 2))
    return bool((right & last).mean() >= _NEARLY_ALL)


def matrices_of(table: Matrices, by_column: bool) -> Matrices:
    """Matrices (N, 3, 4) or (N, 4, 4) of rows of 12 or 16 numbers."""
    rows = table.shape[1] // 4
    return table.reshape(-1, 4, rows).swapaxes(1, 2) if by_column else table.reshape(-1, rows, 4)


def pose_files(folder: Path) -> dict[Path, Layout]:
    """The files of a folder whose lines are poses; none that has an image's name, which it labels."""
    if not folder.is_dir():
        return {}
    pictured = {image.name.partition(".")[0] for image in list_images(folder)}
    texts = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in SUFFIXES and path.name.partition(".")[0] not in pictured and path.is_file()
    ]
    if len(texts) > _MAX_FILES:
        return {}
    return {path: layout for path in texts if (layout := layout_of(path)) is not None}


def read_rows(path: Path, layout: Layout, row: str) -> Table:
    """Read a file whose lines are of a layout; rows of NaN, infinity and zeros are kept; a name alone is NaN.

    Args:
        path: the file.
        layout: of its lines.
        row: what a line is, for messages.

    Raises:
        InputError: where it cannot be read, or a line is anything else.
    """
    lines = [
        (number, line)
        for number, line in enumerate(read_text(path, f"a line each: {row}").splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    numbers = np.empty((len(lines), layout.count))
    names, at, kept = [], 0, []
    for place, (number, line) in enumerate(lines):
        name, words = split_line(line)
        values = as_numbers(words if layout.is_named else [name, *words])
        if layout.is_named and not words and at > 0:  # a tracker's line without a pose
            values = np.full(layout.count, np.nan)
        if values is None or len(values) != layout.count:
            if at == 0 and place < min(_HEADERS, len(lines) - 1):  # names of columns
                continue
            raise InputError(f"{path}, line {number}: is not a line {row!r}, as the others are. Correct or remove it.")
        numbers[at] = values
        names.append(name)
        kept.append(number)
        at += 1
    if not kept:
        raise InputError(f"{path}: is empty; it holds a line each: {row}")
    return Table(path, tuple(kept), tuple(names), numbers[:at])
