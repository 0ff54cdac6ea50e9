"""Trajectories as TUM files, which trajectory tools such as evo read."""

from __future__ import annotations

from collections.abc import Iterable
from decimal import Decimal
from math import isfinite
from pathlib import Path
from typing import Any

from mambaloc.files import atomic_file, writing


def decimal(number: float) -> str:
    """A number with nine digits, as many as float32 has, and six behind the point where it is large, as in UTM."""
    return f"{number:.9g}" if abs(number) < 1000 else f"{number:.6f}"


def stamp(time_s: float | Decimal) -> str:
    """A time to the nanosecond, so that clock times differ where frames do; a whole number as it is."""
    return str(time_s) if isinstance(time_s, int) else f"{time_s:.9f}"


def write_tum(path: Path, time_s: Iterable[float | Decimal], position_m: Any, quaternion: Any) -> None:
    """Write lines ``timestamp tx ty tz qx qy qz qw``, all or none.

    TUM puts the scalar last, unlike everything else here. Rows without a pose, of zeros or NaN, are left out: evo takes
    zeros for a pose at the origin. Positions are written in the world that they are given in.

    Args:
        path: the file.
        time_s: a pose's time each, to the nanosecond: seconds as a float, which has 0.2 us at today's times, or as a
            :class:`~decimal.Decimal`, which has all; or indices, as integers.
        position_m: (N, 3).
        quaternion: (N, 4), unit, wxyz; nine digits are kept, where evo refuses rotations of six.

    Raises:
        InputError: where the file cannot be written.
    """
    rows = zip(time_s, position_m.tolist(), quaternion.tolist(), strict=True)
    posed = (row for row in rows if any(row[2]) and all(map(isfinite, (*row[1], *row[2]))))
    lines = [" ".join([stamp(t), *map(decimal, (*xyz, qx, qy, qz, qw))]) for t, xyz, (qw, qx, qy, qz) in posed]
    with writing(path), atomic_file(path) as partial:
        partial.write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", *lines]) + "\n", encoding="utf-8")
