"""Localise a whole source, filter its poses, and write its trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mambaloc.errors import InputError
from mambaloc.runtime.localiser import Localisation, Localiser
from mambaloc.runtime.pose_filter import PoseFilter, smooth
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

    Ctrl-C ends it; what was found is written then, and also where a frame cannot be localised. The trajectory's times
    are those that the filter takes: seconds since the first frame.

    Args:
        localiser: of the model.
        source: as :func:`~mambaloc.runtime.sources.frames_of` takes it.
        out: the trajectory.
        filtering: one of :data:`FILTERS`; poses are written as found unless given.

    Raises:
        InputError: where there is no such source, it holds no frame, one cannot be localised, or ``out`` has no folder.
    """
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: there is no folder to write that file to; make it, or choose another")
    frames, count = frames_of(source)
    console = Console(stderr=True)
    found: list[tuple[float, Localisation]] = []
    outliers = 0
    try:
        watched = track(frames, "Localising", count, console=console, transient=True)
        for time_s, pose in localiser.localise_each(watched):
            found.append((time_s, pose))  # at once, so that Ctrl-C leaves as many times as poses
    except KeyboardInterrupt:
        pass
    finally:
        if found:
            times_s, poses = zip(*found, strict=True)
            with console.status("Filtering"):
                positions_m, quaternions, outliers = _filtered(filtering, times_s, poses)
            write_tum(out, times_s, positions_m, quaternions)
    if not found:
        raise InputError(f"{source}: holds no frame; give another video")
    latency_ms, unfamiliar = 1000 * _median(poses, "latency_s"), sum(pose.is_unfamiliar for pose in poses)
    tells = localiser.contract.uncertainty is not None
    radii = (_median(poses, "position_radius_m"), _median(poses, "rotation_radius_deg")) if tells else None
    return Followed(len(found), outliers, latency_ms, unfamiliar, radii)


def _median(poses: Sequence[Localisation], of: str) -> float:
    return float(np.median([getattr(pose, of) for pose in poses]))


def _filtered(
    filtering: str | None, times_s: Sequence[float], poses: Sequence[Localisation]
) -> tuple[NDArray[np.floating], NDArray[np.floating], int]:
    """Positions (N, 3), quaternions (N, 4), and how many were left out."""
    positions_m, quaternions = (np.stack([getattr(pose, of) for pose in poses]) for of in ("position_m", "quaternion"))
    if filtering is None:
        return positions_m, quaternions, 0
    if filtering == "smooth":
        estimates = smooth(times_s, positions_m, quaternions)
    else:
        estimates = [*map(PoseFilter().update, times_s, positions_m, quaternions)]
    positions_m, quaternions = (np.stack([getattr(e, of) for e in estimates]) for of in ("position_m", "quaternion"))
    return positions_m, quaternions, sum(estimate.is_outlier for estimate in estimates)
