"""Measure frames from the decode-once cache against decoding every frame every epoch, on one core.

python tools/benchmarks/loading.py [--dataset NAME] [--root FOLDER] [--scene NAME] [--augmentation rotation]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import cv2
import torch
from rich.progress import track
from torch import Tensor

from mambaloc import provenance
from mambaloc.benchmark.reference import DecodedFrames
from mambaloc.console import OptionParser, configure_logging, exit_on_input_error
from mambaloc.data import PoseDataModule
from mambaloc.memory import keep_freed_memory

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class LoadingRates:
    """Images a second, one figure a repetition, of both ways of loading."""

    cached: list[float]
    decoded: list[float]

    @property
    def ratio(self) -> float:
        """How many times faster the cache is, by medians."""
        return median(self.cached) / median(self.decoded)


@exit_on_input_error
def main() -> None:
    """Measure a scene and print."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    options = {"dataset": "embedded", "root": None, "scene": "heads", "augmentation": "crop"}
    for name, default in options.items():
        parser.add_argument(f"--{name}", default=default)
    print_loading(measure_loading(PoseDataModule(**vars(parser.parse_args()))), provenance.machine())


def measure_loading(data: PoseDataModule, batches: int = 32, repetitions: int = 5) -> LoadingRates:
    """Time both ways from disk to a normalised, augmented float batch, alternating, after a warm-up of each.

    The reference is what AtLoc's program does: PIL, resize, random crop, colour jitter, normalise, a frame at a time.
    Neither uses a second core.

    Args:
        data: the scene; its training frames are loaded.
        batches: batches a repetition.
        repetitions: timed repetitions of each way.
    """
    threads = torch.get_num_threads()
    keep_freed_memory()  # as a training does
    data.setup("fit")
    try:
        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        ways = {"cached": _cached(data), "decoded": _decoded(data)}
        rates: dict[str, list[float]] = {name: [] for name in ways}
        for repetition in track(range(repetitions + 1), "Loading", transient=True):
            for name, load in ways.items():
                rate = _images_per_second(load, data.hparams["batch_size"], batches, len(data.frames("train")))
                if repetition:  # the first warms up
                    rates[name].append(rate)
    finally:
        torch.set_num_threads(threads)
        cv2.setNumThreads(-1)
    return LoadingRates(**rates)


def print_loading(rates: LoadingRates, machine: str) -> None:
    """Print images per second, and their ratio."""
    for name, figures in (("decode-once cache", rates.cached), ("decode every epoch", rates.decoded)):
        print(f"{name:20}{median(figures):8.0f} images/s on one core  ({min(figures):.0f} to {max(figures):.0f})")
    print(f"ratio {rates.ratio:.1f}   {machine}")


def _images_per_second(load: Callable[[list[int]], Tensor], batch_size: int, batches: int, frames: int) -> float:
    order = torch.randperm(frames, generator=torch.Generator().manual_seed(0)).tolist()
    start = time.perf_counter()
    for batch in range(batches):
        load([order[(batch * batch_size + i) % frames] for i in range(batch_size)])
    return batches * batch_size / (time.perf_counter() - start)


def _cached(data: PoseDataModule) -> Callable[[list[int]], Tensor]:
    frames = data.train_dataloader().dataset
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in (_MEAN, _STD))

    def load(indices: list[int]) -> Tensor:
        batch = frames.__getitems__(indices)  # type: ignore[attr-defined]
        return data.augmented(batch, epoch=0).image.sub_(mean).div_(std)

    return load


def _decoded(data: PoseDataModule) -> Callable[[list[int]], Tensor]:
    frames = DecodedFrames(data, list(_MEAN), list(_STD))

    def load(indices: list[int]) -> Tensor:
        return torch.stack([frames[i][0] for i in indices])

    return load


if __name__ == "__main__":
    main()
