"""What tools show of localising: a progress bar, and a bundle's deviations as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from mambaloc.errors import InputError
from mambaloc.runtime.bundle import Deviation
from mambaloc.runtime.localiser import Localisation, Localiser
from mambaloc.runtime.pose_filter import PICTURES_HZ, PoseFilter, smooth
from mambaloc.runtime.sources import frames_of
from mambaloc.runtime.trajectory import write_tum

FILTERS = ("causal", "smooth")
"""How a video's poses may be filtered: each from those until then, or from all."""


@dataclass(frozen=True)
class Followed:
    """What became of a source's frames.

    Args:
        count: of the frames.
        outliers: of them, those whose poses a filter left out.
        latency_ms: median of a frame.
        unfamiliar: of them, those that do not look like the place; none where the model cannot tell.
        radii: medians of what nine of ten poses are within, in metres and degrees, where the model tells.
    """

    count: int
    outliers: int
    latency_ms: float
    unfamiliar: int = 0
    radii: tuple[float, float] | None = None


def follow(localiser: Localiser, source: str, out: Path, filtering: str | None = None) -> Followed:
    """Localise every frame of a source with a progress bar on stderr, and write a TUM trajectory.

    Ctrl-C ends it; what was found is written then, and also where a frame cannot be localised.

    Args:
        localiser: of the model.
        source: as :meth:`Localiser.localise_each` takes it.
        out: the trajectory.
        filtering: one of :data:`FILTERS`; poses are written as found unless given.

    Raises:
        InputError: where there is no such source, it holds no frame, one cannot be localised, or ``out`` has no folder.
    """
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: there is no folder to write that file to; make it, or choose another")
    frames, count = frames_of(source)
    console = Console(stderr=True)
    times: list[float] = []
    poses: list[Localisation] = []
    outliers = 0
    try:
        for frame in track(frames, "Localising", count, console=console, transient=True):
            poses.append(localiser.localise(frame.image))
            times.append(frame.time_s)
    except KeyboardInterrupt:
        poses = poses[: len(times)]
    finally:
        if times:
            with console.status("Filtering"):
                seconds = np.divide(times, PICTURES_HZ) if Path(source).is_dir() else times
                positions_m, quaternions, outliers = _filtered(filtering, seconds, poses)
            write_tum(out, times, positions_m, quaternions)
    if not times:
        raise InputError(f"{source}: holds no frame; give another video")
    latency_ms, unfamiliar = 1000 * _median(poses, "latency_s"), sum(pose.is_unfamiliar for pose in poses)
    tells = localiser.contract.uncertainty is not None
    radii = (_median(poses, "position_radius_m"), _median(poses, "rotation_radius_deg")) if tells else None
    return Followed(len(times), outliers, latency_ms, unfamiliar, radii)


def _median(poses: Sequence[Localisation], of: str) -> float:
    return float(np.median([getattr(pose, of) for pose in poses]))


def _filtered(
    filtering: str | None, times_s: ArrayLike, poses: list[Localisation]
) -> tuple[NDArray[np.floating], NDArray[np.floating], int]:
    """Positions (N, 3), quaternions (N, 4), and how many were left out."""
    positions_m, quaternions = (np.stack([getattr(pose, of) for pose in poses]) for of in ("position_m", "quaternion"))
    if filtering is None:
        return positions_m, quaternions, 0
    if filtering == "smooth":
        estimates = smooth(times_s, positions_m, quaternions)
    else:
        estimates = [*map(PoseFilter().update, np.asarray(times_s), positions_m, quaternions)]
    positions_m, quaternions = (np.stack([getattr(e, of) for e in estimates]) for of in ("position_m", "quaternion"))
    return positions_m, quaternions, sum(estimate.is_outlier for estimate in estimates)


def print_deviations(deviations: Sequence[Deviation]) -> None:
    """Print a row a model."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for column in ("model", "mm", "deg", "ms", ""):
        table.add_column(column, justify="left" if column in ("model", "") else "right")
    for each in deviations:
        numbers = (f"{each.position_mm:.3g}", f"{each.rotation_deg:.2g}", f"{each.latency_ms:.1f}")
        table.add_row(each.file, *numbers, "within bounds" if each.within else "DEVIATES")
    Console(highlight=False).print(table)
