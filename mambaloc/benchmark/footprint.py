"""Seconds and memory of whole epochs by number of frames, each training in a process of its own."""

from __future__ import annotations

import multiprocessing
import resource
import sys
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

from mambaloc.benchmark.clock import now
from mambaloc.benchmark.setting import BenchmarkConfig
from mambaloc.console import configure_logging

Measured = TypeVar("Measured")

STATUS = Path("/proc/self/status")
"""What Linux says of this process."""


@dataclass(frozen=True)
class Footprint:
    """One training in a process of its own.

    Args:
        frames: that it trains on.
        epoch_s: of the fastest epoch after the first.
        host_bytes: largest resident memory of the process, mapped pages of the cache included.
        device_bytes: largest memory that tensors took on a GPU; 0 without one.
    """

    frames: int
    epoch_s: float
    host_bytes: int
    device_bytes: int


def measure_scaling(setting: BenchmarkConfig, frames: Sequence[int], epochs: int = 3) -> list[Footprint]:
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
        found.append(in_a_process(_train, thinned, epochs))
    return found


def exponent(frames: Sequence[int], costs: Sequence[float]) -> float:
    """Slope of log cost over log frames, by least squares: 1 where cost is proportional."""
    return float(np.polyfit(np.log(frames), np.log(costs), 1)[0])


def in_a_process(measure: Callable[..., Measured], *args: Any) -> Measured:
    """Run a measurement in a new process, which begins with none of this one's memory."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=configure_logging) as pool:
        return pool.submit(measure, *args).result()


class _EpochClock(L.Callback):
    """How long each epoch took."""

    def __init__(self) -> None:
        self.epochs_s: list[float] = []

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._start = now(pl_module.device)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.epochs_s.append(now(pl_module.device) - self._start)


def _train(setting: BenchmarkConfig, epochs: int) -> Footprint:
    system, data = setting.build()
    clock = _EpochClock()
    setting.fit(system, data, clock, max_epochs=epochs)
    return Footprint(len(data.frames("train")), min(clock.epochs_s[1:]), peak_bytes(), device_peak_bytes())


def peak_bytes() -> int:
    """Largest resident memory of this process so far."""
    if STATUS.is_file():  # what getrusage reports on Linux begins with the memory of the process that started this one
        return proc_value(STATUS, "VmHWM:") * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def device_peak_bytes() -> int:
    """Largest memory that this process's tensors took on a GPU so far; 0 without one."""
    return torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0


def proc_value(file: Path, *names: str) -> int:
    """Sum of the numbers that a file of ``/proc`` gives these names; those of memory are kilobytes."""
    lines = (line.split() for line in file.read_text(encoding="utf-8").splitlines())
    return sum(int(words[1]) for words in lines if words and words[0] in names)
