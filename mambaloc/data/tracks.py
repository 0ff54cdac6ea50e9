"""Points that structure from motion found, and where frames see them: ``SCENE/points.safetensors``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save_file

from mambaloc.data.datasets.capture import read_rows
from mambaloc.data.frames import Frames
from mambaloc.errors import InputError

POINTS_FILE = "points.safetensors"
"""What an imported scene calls them."""
_MAX_BYTES = 2**31
_ARRAYS = {"points_m": (np.float64, 3), "point": (np.int64, 0), "frame": (np.int64, 0), "rays": (np.float64, 2)}


@dataclass(frozen=True)
class Tracks:
    """Points, and where frames see them, one row an observation.

    Shape:
        ``points_m`` (P, 3) in the world; ``point`` (O,) and ``frame`` (O,), rows of both; ``rays`` (O, 2), where the
        plane at depth 1 is met, without distortion.
    """

    points_m: NDArray[np.float64]
    point: NDArray[np.int64]
    frame: NDArray[np.int64]
    rays: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.points_m)

    def of_frames(self, rows: NDArray[np.int64]) -> Tracks:
        """What some frames see, numbered in their new order; points that no frame sees are left out."""
        if not len(rows):
            return Tracks(self.points_m[:0], self.point[:0], self.frame[:0], self.rays[:0])
        order = np.argsort(rows, kind="stable")
        at = order[np.minimum(np.searchsorted(rows, self.frame, sorter=order), len(rows) - 1)]
        kept = np.flatnonzero(rows[at] == self.frame)
        seen, point = np.unique(self.point[kept], return_inverse=True)
        return Tracks(self.points_m[seen], point.astype(np.int64), at[kept], self.rays[kept])

    def moved(self, scale: float, shift: NDArray[np.float64]) -> Tracks:
        """The same in a world that is scaled, then shifted by (3,)."""
        return replace(self, points_m=self.points_m * scale + shift)

    def write(self, folder: Path) -> None:
        """Write them to a scene's folder."""
        save_file({name: np.ascontiguousarray(getattr(self, name)) for name in _ARRAYS}, folder / POINTS_FILE)


def read_tracks(folder: Path, frames: int) -> Tracks | None:
    """Read the points of an imported scene; None where it has none.

    Args:
        folder: the scene's.
        frames: how many it has, in the order of ``frames.csv``.

    Raises:
        InputError: for a file that is damaged or of other frames.
    """
    path = folder / POINTS_FILE
    if not path.is_file():
        return None
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"it is larger than {_MAX_BYTES} bytes")
        arrays = load(path.read_bytes())
        _check(arrays, frames)
        return Tracks(*(arrays[name] for name in _ARRAYS))
    except (OSError, ValueError, KeyError, SafetensorError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: is damaged ({reason[:200]}). Import the scene again, or remove the file.") from None


def tracks_of_frames(folder: Path, frames: Frames) -> Tracks | None:
    """Points that some frames of an imported scene see, numbered in the order of ``frames``; None where it has none.

    Raises:
        InputError: as :func:`read_tracks`.
    """
    row_of = {row.image: number for number, row in enumerate(read_rows(folder))}
    tracks = read_tracks(folder, len(row_of))
    return tracks and tracks.of_frames(np.array([row_of[image] for image in frames.image_paths]))


def _check(arrays: dict[str, Any], frames: int) -> None:
    for name, (dtype, columns) in _ARRAYS.items():
        if arrays[name].dtype != dtype or arrays[name].shape[1:] != ((columns,) if columns else ()):
            raise ValueError(f"{name} is {arrays[name].dtype} {arrays[name].shape}")
    if len({len(arrays[name]) for name in ("point", "frame", "rays")}) != 1:
        raise ValueError("its observations are of different lengths")
    for name, count in (("point", len(arrays["points_m"])), ("frame", frames)):
        if len(arrays[name]) and not 0 <= arrays[name].min() <= arrays[name].max() < count:
            raise ValueError(f"{name} is not within 0 to {count - 1}")
    if not (np.isfinite(arrays["points_m"]).all() and np.isfinite(arrays["rays"]).all()):
        raise ValueError("numbers are not finite")
