"""What tools show of localising: a progress bar, and a bundle's deviations as a table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from mambaloc.errors import InputError
from mambaloc.runtime.bundle import Deviation
from mambaloc.runtime.localiser import Localisation, Localiser
from mambaloc.runtime.sources import frames_of
from mambaloc.runtime.trajectory import write_tum


def follow(localiser: Localiser, source: str, out: Path) -> tuple[int, float]:
    """Localise every frame of a source with a progress bar on stderr, and write a TUM trajectory.

    Ctrl-C ends it; what was found is written then, and also where a frame cannot be localised.

    Args:
        localiser: of the model.
        source: as :meth:`Localiser.localise_each` takes it.
        out: the trajectory.

    Returns:
        How many frames there were, and the median of their latencies in milliseconds.

    Raises:
        InputError: where there is no such source, it holds no frame, one cannot be localised, or ``out`` has no folder.
    """
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: there is no folder to write that file to; make it, or choose another")
    frames, count = frames_of(source)
    times: list[float] = []
    poses: list[Localisation] = []
    try:
        for frame in track(frames, "Localising", count, console=Console(stderr=True), transient=True):
            poses.append(localiser.localise(frame.image))
            times.append(frame.time_s)
    except KeyboardInterrupt:
        poses = poses[: len(times)]
    finally:
        if times:
            positions_m, quaternions = (
                np.stack([getattr(p, of) for p in poses]) for of in ("position_m", "quaternion")
            )
            write_tum(out, times, positions_m, quaternions)
    if not times:
        raise InputError(f"{source}: holds no frame; give another video")
    return len(times), 1000 * float(np.median([pose.latency_s for pose in poses]))


def print_deviations(deviations: Sequence[Deviation]) -> None:
    """Print a row a model."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for column in ("model", "mm", "deg", "ms", ""):
        table.add_column(column, justify="left" if column in ("model", "") else "right")
    for each in deviations:
        numbers = (f"{each.position_mm:.3g}", f"{each.rotation_deg:.2g}", f"{each.latency_ms:.1f}")
        table.add_row(each.file, *numbers, "within bounds" if each.within else "DEVIATES")
    Console(highlight=False).print(table)
