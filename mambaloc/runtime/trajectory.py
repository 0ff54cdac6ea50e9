"""Trajectories as TUM files, which trajectory tools such as evo read."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mambaloc.files import whole_file, writing


def decimal(number: float) -> str:
    """A number with nine digits, as many as float32 has, and six behind the point where it is large, as in UTM."""
    return f"{number:.9g}" if abs(number) < 1000 else f"{number:.6f}"


def write_tum(path: Path, time_s: Iterable[float], position_m: Any, quaternion: Any) -> None:
    """Write lines ``timestamp tx ty tz qx qy qz qw``, of arrays or tensors (N, 3) and (N, 4) wxyz, all or none of them.

    TUM puts the scalar last, unlike everything else here. Positions are written in the world that they are given in.

    Raises:
        InputError: where the file cannot be written.
    """
    rows = zip(time_s, position_m.tolist(), quaternion.tolist(), strict=True)
    lines = [" ".join(decimal(n) for n in (t, *xyz, qx, qy, qz, qw)) for t, xyz, (qw, qx, qy, qz) in rows]
    with writing(path), whole_file(path) as partial:
        partial.write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", *lines]) + "\n", encoding="utf-8")
