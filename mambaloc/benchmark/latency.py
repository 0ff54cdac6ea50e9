"""What GIS costs: forward passes and training steps of every system with it, as ratios to the system without."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median, quantiles

import torch
from rich.console import Console
from rich.progress import track
from torch.utils.flop_counter import FlopCounterMode

from mambaloc.errors import InputError
from mambaloc.geometry import canonical, transform
from mambaloc.models import LitPoseRegressor, create_model
from mambaloc.types import Pose, PoseBatch, height_and_width

WARM_UP = 3


@dataclass(frozen=True)
class Latency:
    """Times of one system at one batch size, without and with GIS, taken in turns.

    Args:
        system: its name.
        what: ``forward`` or ``training step``.
        batch: images.
        without_s: seconds a repetition without GIS.
        with_s: the same with GIS.
    """

    system: str
    what: str
    batch: int
    without_s: list[float]
    with_s: list[float]

    @property
    def ratio(self) -> float:
        """Of the medians: what GIS multiplies the time by."""
        return median(self.with_s) / median(self.without_s)

    @property
    def spread(self) -> float:
        """Interquartile range of the ratios of neighbouring repetitions."""
        low, _, high = quantiles([w / wo for w, wo in zip(self.with_s, self.without_s, strict=True)], n=4)
        return high - low


def measure_latency(
    systems: Sequence[str],
    image_size: int = 224,
    batches: Sequence[int] = (1, 8),
    repetitions: int = 20,
    device: str = "cpu",
) -> list[Latency]:
    """Time forward passes and training steps, without and with GIS in turns, so that both meet the same machine.

    Raises:
        InputError: for a device that is not there, or too few repetitions to estimate a spread.
    """
    if repetitions < 4:
        raise InputError(f"--repetitions {repetitions}: quartiles need 4 or more")
    visible = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    if device not in visible:
        raise InputError(f"--device {device}: not available; choose one of {', '.join(visible)}")
    cells = [(name, batch) for name in systems for batch in batches]
    console = Console(stderr=True)
    found: list[Latency] = []
    for name, batch in track(cells, "timing", console=console, transient=True):
        pair = [create_model(name, gis=gis, image_size=image_size).to(device) for gis in ("none", "gis")]
        frames = random_frames(batch, image_size, device)
        for what, call in (("forward", forward), ("training step", training_step)):
            calls = [call(system, frames) for system in pair]
            found.append(Latency(name, what, batch, *in_turns(calls, repetitions, device)))
    return found


def forward_flops(name: str, gis: str, image_size: int = 224) -> int:
    """Floating-point operations of one image's forward pass: twice its multiply-adds in products and convolutions."""
    system = create_model(name, gis=gis, image_size=image_size).eval()
    with FlopCounterMode(display=False) as counter, torch.inference_mode():
        system(torch.zeros(1, 3, image_size, image_size))
    return counter.get_total_flops()


def forward(system: LitPoseRegressor, frames: PoseBatch) -> Callable[[], object]:
    """A forward pass as in use: no gradients, no dropout."""

    def call() -> object:
        system.eval()
        with torch.inference_mode():
            return system(frames.image, frames.intrinsics)

    return call


def training_step(system: LitPoseRegressor, frames: PoseBatch) -> Callable[[], object]:
    """Forward, loss, backward and optimiser step."""
    optimizer = system.configure_optimizers()["optimizer"]

    def call() -> None:
        system.train()
        system.loss.train(frames.clip_length > 1)  # a single image has no relative pose, which only training refuses
        optimizer.zero_grad()
        system.loss(system(frames.image, frames.intrinsics), frames).backward()
        optimizer.step()

    return call


def random_frames(count: int, image_size: int | tuple[int, int], device: str = "cpu", seed: int = 0) -> PoseBatch:
    """A batch that every loss can read: one clip, each frame with scene points in view."""
    generator = torch.Generator().manual_seed(seed)
    position_m = torch.randn(count, 3, generator=generator)
    quaternion = canonical(torch.randn(count, 4, generator=generator))
    ahead_m = torch.randn(count, 64, 3, generator=generator) * 0.3 + torch.tensor([0.0, 0.0, 3.0])
    height, width = height_and_width(image_size)
    intrinsics = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    return PoseBatch(
        image=torch.rand(count, 3, height, width, generator=generator).to(device),
        position_m=position_m.to(device),
        quaternion=quaternion.to(device),
        index=torch.arange(count, device=device),
        clip_length=count,
        points_m=transform(Pose(position_m[:, None], quaternion[:, None]), ahead_m).to(device),
        intrinsics=intrinsics.expand(count, 3, 3).to(device),
    )


def in_turns(calls: Sequence[Callable[[], object]], repetitions: int, device: str = "cpu") -> list[list[float]]:
    """Seconds of each call, one after the other so many times, after a warm-up: all meet the same machine."""
    for _ in range(WARM_UP):
        for call in calls:
            call()
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(repetitions):
        for call, taken in zip(calls, times, strict=True):
            taken.append(_timed(call, device))
    return times


def _timed(call: Callable[[], object], device: str) -> float:
    synchronize = torch.cuda.synchronize if device.startswith("cuda") else (lambda: None)
    synchronize()
    start = time.perf_counter()
    call()
    synchronize()
    return time.perf_counter() - start
