"""What a training costs from its process's start: memory, seconds to the first step, and both by number of frames."""

from __future__ import annotations

import multiprocessing
import resource
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import lightning as L
import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from mambaloc.benchmark.reference import Published, ReferenceLoop
from mambaloc.benchmark.speed import OURS, REFERENCE, Setting, now
from mambaloc.console import quieten
from mambaloc.models.transposenet import LitTransPoseNet

Measured = TypeVar("Measured")

STATUS = Path("/proc/self/status")
"""What Linux says of this process."""


@dataclass(frozen=True)
class Footprint:
    """One training in a process of its own.

    Args:
        way: ours or the reference.
        frames: that it trains on.
        first_step_s: from the start of the process to the end of the first step.
        epoch_s: of the fastest epoch after the first; NaN where there was one.
        host_bytes: largest resident memory of the process, mapped pages of the cache included, and what its loader's
            processes have to themselves.
        device_bytes: largest memory that tensors took on a GPU; 0 without one.
    """

    way: str
    frames: int
    first_step_s: float
    epoch_s: float
    host_bytes: int
    device_bytes: int


def measure_footprints(setting: Setting, steps: int = 4, workers: int = 2) -> list[Footprint]:
    """Train a few steps, ours and the reference, each in a process of its own."""
    return [
        in_a_process(_ours, setting, time.time(), steps, 1),
        in_a_process(_reference, setting, time.time(), steps, workers),
    ]


def measure_scaling(setting: Setting, frames: Sequence[int], epochs: int = 3) -> list[Footprint]:
    """Train whole epochs on so many frames of a scene, each in a process of its own.

    Args:
        setting: what is trained on what.
        frames: how many, uniform in time.
        epochs: of each; the first warms up.

    Raises:
        InputError: where the scene has fewer.
    """
    found = []
    for count in track(frames, "measuring epochs", console=Console(stderr=True), transient=True):
        thinned = replace(setting, data={**setting.data, "keep_count": count})
        found.append(in_a_process(_ours, thinned, time.time(), None, epochs))
    return found


def exponent(frames: Sequence[int], costs: Sequence[float]) -> float:
    """Slope of log cost over log frames, by least squares: 1 where cost is proportional."""
    return float(np.polyfit(np.log(frames), np.log(costs), 1)[0])


def in_a_process(measure: Callable[..., Measured], *args: Any) -> Measured:
    """Run a measurement in a new process, which begins with none of this one's memory."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=quieten) as pool:
        return pool.submit(measure, *args).result()


class _Clock(L.Callback):
    """When the first step ended, and how long each epoch took."""

    def __init__(self) -> None:
        self.first_step_at = 0.0
        self.epochs_s: list[float] = []

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._start = now(pl_module.device)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        if not self.first_step_at:
            now(pl_module.device)
            self.first_step_at = time.time()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.epochs_s.append(now(pl_module.device) - self._start)


def _ours(setting: Setting, started_at: float, steps: int | None, epochs: int) -> Footprint:
    system, data = setting.build()
    clock = _Clock()
    setting.fit(system, data, clock, max_epochs=epochs, limit_train_batches=steps or 1.0)
    return Footprint(
        OURS,
        len(data.frames("train")),
        clock.first_step_at - started_at,
        min(clock.epochs_s[1:], default=float("nan")),
        peak_bytes(),
        torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0,
    )


def _reference(setting: Setting, started_at: float, steps: int, workers: int) -> Footprint:
    system, data = setting.build()
    data.setup("fit")
    network = Published(system) if isinstance(system, LitTransPoseNet) else None
    loop = ReferenceLoop(system, data, network, steps, setting.device, workers)
    ended_at: list[float] = []
    loop.train(lambda part: ended_at.append(time.time()) if part == "optimiser" else None)
    return Footprint(
        REFERENCE,
        len(data.frames("train")),
        ended_at[0] - started_at,
        float("nan"),
        peak_bytes() + _workers_bytes(),
        torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0,
    )


def peak_bytes() -> int:
    """Largest resident memory of this process so far."""
    if STATUS.is_file():  # what getrusage tells on Linux begins with the memory of the process that started this one
        return said_of(STATUS, "VmHWM:") * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _workers_bytes() -> int:
    """Memory that loader processes share with nobody; 0 where the system does not tell."""
    rolls = [Path(f"/proc/{worker.pid}/smaps_rollup") for worker in multiprocessing.active_children()]
    return sum(1024 * said_of(roll, "Private_Clean:", "Private_Dirty:") for roll in rolls if roll.is_file())


def said_of(file: Path, *names: str) -> int:
    """Sum of the numbers that a file of ``/proc`` gives these names; those of memory are kilobytes."""
    lines = (line.split() for line in file.read_text(encoding="utf-8").splitlines())
    return sum(int(words[1]) for words in lines if words and words[0] in names)
