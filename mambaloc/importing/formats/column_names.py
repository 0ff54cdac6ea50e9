"""Names of columns as programs write them: what each holds, and the unit that its name says.

``x``, ``x [m]``, ``x_cm``, ``pos_x[mm]``, ``p_RS_R_x [m]`` (EuRoC), ``pose.position.x`` (ROS), ``qw []``, ``time_ms``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from mambaloc.errors import InputError

_LENGTHS_M = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 0.001),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 0.01),
    "dm": 0.1,
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1000.0),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
}
_NO_UNITS = ("", "-", "1", "unit", "units", "a.u.")
TIMES = ("time", "timestamp", "stamp")
"""Names of a column of times, without its unit."""

_COLUMN = re.compile(r"[^\s,;\[(]+(?:\s*[\[(][^\])]*[\])])?")
_BRACKETED = re.compile(r"(.*?)\s*[\[(]([^\])]*)[\])]")
_OF_LENGTH = re.compile(r"(.*[xyz])_(m|mm|cm|dm|km|ft)")
_OF_TIME = re.compile(rf"({'|'.join(TIMES)})_(s|ms|us|ns)")
_BEFORE = r"(?:(?:field|pose|camera|cam)[._/ ]?)*"
_POSITION = r"(?:(?:position|pos|translation|trans|location)|[pt](?:_[a-z]{1,2}){0,2})?"
_QUATERNION = r"(?:quaternion|quat|orientation|rotation|rot|q(?:_[a-z]{1,2}){0,2})"


@dataclass(frozen=True)
class Column:
    """A column's name in lower case without its unit, and that; empty where the name says none."""

    name: str
    unit: str = ""


def column_of(name: str) -> Column:
    """What a column's name says."""
    name = name.strip().strip("\"'").lower()
    match = _BRACKETED.fullmatch(name) or _OF_LENGTH.fullmatch(name) or _OF_TIME.fullmatch(name)
    name, unit = (name, "") if match is None else (match[1], match[2].strip())
    return Column(re.sub(r"\s+", "_", name), unit)


def columns_in(line: str) -> tuple[Column, ...]:
    """The columns that a line names, between spaces, commas or semicolons; units may stand apart, in brackets."""
    return tuple(column_of(name) for name in _COLUMN.findall(line))


def find_position(names: Sequence[str]) -> list[tuple[str, ...]]:
    """The columns x, y, z of positions, for each way in which all three are named."""
    return _complete(names, f"{_BEFORE}{_POSITION}[._/ ]?", "xyz")


def find_quaternion(names: Sequence[str]) -> list[tuple[str, ...]]:
    """The columns w, x, y, z of quaternions, for each way in which all four are named."""
    return _complete(names, f"{_BEFORE}{_QUATERNION}[._/ ]?", "wxyz")


def _complete(names: Sequence[str], before: str, axes: str) -> list[tuple[str, ...]]:
    starts = dict.fromkeys(name[:-1] for name in names if re.fullmatch(f"{before}[{axes}]", name))
    found = [tuple(start + axis for axis in axes) for start in starts]
    return [each for each in found if set(each) <= set(names)]


def scale_of(metres: float | None, otherwise: str) -> str:
    """What was decided of the scale, of what :func:`metres_per_unit` returns."""
    return otherwise if metres is None else f"{metres:g} m, as the columns' names say"


def metres_per_unit(columns: Sequence[Column], where: str) -> float | None:
    """What the names of a position's columns say of its unit; None where they say nothing.

    Args:
        columns: three, or none.
        where: their line, for messages.

    Raises:
        InputError: for a unit that is not a length, or several.
    """
    units = {column.unit for column in columns}
    if units <= set(_NO_UNITS):
        return None
    lengths_m = {_LENGTHS_M.get(unit) for unit in units}
    (length_m,) = lengths_m if len(lengths_m) == 1 else (None,)
    if length_m is None:
        named = ", ".join(f"{column.name} [{column.unit}]" for column in columns)
        raise InputError(f"{where}: positions are in no one unit of length ({named:.80}). Write x, y and z in metres.")
    return length_m
