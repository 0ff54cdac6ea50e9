"""Which column of a table of poses holds what, by the names in its first line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mambaloc.errors import InputError
from mambaloc.importing.formats.column_names import (
    TIMES,
    Column,
    column_of,
    find_position,
    find_quaternion,
    metres_per_unit,
)

_IMAGE = ("image", "img_path", "image_path", "path", "file", "filename", "file_name", "image_name", "name", "img")
POSITIONS = (("x", "y", "z"), ("tx", "ty", "tz"), ("t1", "t2", "t3"))
"""Columns of a position: of tables of this project and others, and of TransPoseNet's, the last."""
_QUATERNIONS = (("qw", "qx", "qy", "qz"), ("q1", "q2", "q3", "q4"))
_TRANSPOSENET = (POSITIONS[2], _QUATERNIONS[1])
_FRAME = ("frame", "frame_number", "frame_index", "index")
_SEQUENCE = ("seq", "sequence")


@dataclass(frozen=True)
class TableColumns:
    """Which column holds what.

    Args:
        names: of all columns, in order.
        image: of an image's file, where there is one.
        position: three.
        quaternion: four, scalar first.
        sequence: of a recording, where there is one.
        time: of the frame; in a table without images or times, a frame's number.
        time_unit: that the time's name says; empty where it says none.
        metres_per_unit: what the position's names say; None where they say nothing.
    """

    names: tuple[str, ...]
    image: str | None
    position: tuple[str, ...]
    quaternion: tuple[str, ...]
    sequence: str | None
    time: str | None
    time_unit: str
    metres_per_unit: float | None


def _names(path: Path, named: Sequence[Column]) -> list[str]:
    """A name for each column: without its unit, where only one has that."""
    twice = next((column.name for column in named if column.name and named.count(column) > 1), None)
    if twice:
        raise InputError(f"{path}, line 1: names the column {twice[:40]!r} twice; remove one")
    count = Counter(column.name for column in named)
    return [column.name if count[column.name] == 1 else f"{column.name} [{column.unit}]" for column in named]


def columns_of(path: Path, header: Sequence[str]) -> TableColumns:
    """What a table's columns hold.

    Args:
        path: the table, for messages.
        header: the words of its first line.

    Raises:
        InputError: for a column that is missing, or may be one of several.
    """
    columns = [column_of(word.lstrip("# ")) for word in header]
    names = _names(path, columns)
    named = dict(zip(names, columns, strict=True))

    def the_one(what: str, sets: Sequence[tuple[str, ...]], others: Sequence[tuple[str, ...]] = ()) -> tuple[str, ...]:
        found = [each for each in sets if set(each) <= set(names)] or others
        if len(found) != 1:
            wanted = " or ".join(",".join(each) for each in sets)
            raise InputError(
                f"{path}, line 1: must name the {what} once ({wanted}); it names {','.join(names)[:200]!r}"
            )
        return found[0]

    def at_most_one(what: str, known: Sequence[str]) -> str | None:
        found = [name for name in known if name in names]
        return the_one(what, [(name,) for name in known])[0] if found else None

    time, image = at_most_one("time", TIMES), at_most_one("image file", _IMAGE)
    if image is None and time is None:
        time = at_most_one("frame's number", _FRAME)
    if image is None and time is None:
        the_one("image file", [(name,) for name in _IMAGE])
    position = the_one("position", POSITIONS, find_position(names))
    quaternion = the_one("quaternion", _QUATERNIONS, find_quaternion(names))
    if quaternion == _QUATERNIONS[1] and (position, quaternion) != _TRANSPOSENET:
        raise InputError(f"{path}, line 1: q1,q2,q3,q4 do not say which is the scalar; name them qw,qx,qy,qz")
    return TableColumns(
        names=tuple(names),
        image=image,
        position=position,
        quaternion=quaternion,
        sequence=at_most_one("sequence", _SEQUENCE),
        time=time,
        time_unit="" if time is None else named[time].unit,
        metres_per_unit=metres_per_unit([named[name] for name in position], f"{path}, line 1"),
    )
