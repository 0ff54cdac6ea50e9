"""How far a training step is from what the machine could do, and which kernels take its time."""

from __future__ import annotations

import os
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from mambaloc.benchmark.latency import in_turns, random_frames, training_step
from mambaloc.benchmark.speed import Setting
from mambaloc.models import LitPoseRegressor

_ADAM_BYTES = 7 * 4  # a parameter's float32 value, gradient and two moments are read, and but the gradient written
_SIDE, _COPIED = {"cpu": 2048, "cuda": 8192}, {"cpu": 2**28, "cuda": 2**30}


@dataclass(frozen=True)
class Floors:
    """A step's time, and the two times under which no step like it can be.

    Args:
        step_s: of a whole step, eager, on a batch that is there, median.
        flops: of its products and convolutions, forward and backward.
        bytes: that it must move: each weight read twice and its gradient written, the optimiser's state, and each
            tensor that is kept for the backward pass written and read.
        flops_per_s: of a large product in the setting's precision, here.
        bytes_per_s: of a large copy, here.
        kernels: share of the step's time by kernel, largest first.
    """

    step_s: float
    flops: int
    bytes: int
    flops_per_s: float
    bytes_per_s: float
    kernels: list[tuple[str, float]]

    @property
    def of_operations(self) -> float:
        """Share of the machine's rate of operations that the step reaches."""
        return self.flops / self.flops_per_s / self.step_s

    @property
    def of_bytes(self) -> float:
        """Share of the machine's bandwidth that the step must reach."""
        return self.bytes / self.bytes_per_s / self.step_s


def measure_floors(setting: Setting, batch: int, repetitions: int = 5) -> Floors:
    """Count a step's operations and bytes, and time it, a product, and a copy on the setting's device."""
    system, data = setting.build()
    device, half = setting.device, setting.is_half
    system.to(device).schedule = "step"  # others ask a trainer how long they are; the rate costs nothing
    frames = random_frames(batch, data.crop, device.type)
    with torch.autocast(device.type, torch.bfloat16, enabled=half):
        kept_bytes = _kept_for_backward(system, frames.image)
    with FlopCounterMode(display=False) as counter:
        with torch.autocast(device.type, torch.bfloat16, enabled=half):
            loss = _loss(system, frames.image)
        loss.backward()
    step = training_step(system, frames, half)
    side, dtype = _SIDE[device.type], torch.bfloat16 if half else torch.float32
    square = torch.randn(side, side, device=device, dtype=dtype)
    source = torch.zeros(_COPIED[device.type], dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    calls = [step, lambda: square @ square, lambda: target.copy_(source)]
    step_s, product_s, copy_s = (median(taken) for taken in in_turns(calls, repetitions, device.type))
    kernels = _kernels(step, device)
    parameters = sum(p.numel() for p in system.parameters() if p.requires_grad)
    return Floors(
        step_s,
        counter.get_total_flops(),
        parameters * (3 * 4 + _ADAM_BYTES) + 2 * kept_bytes,
        2 * side**3 / product_s,
        2 * source.nbytes / copy_s,
        kernels,
    )


def _loss(system: LitPoseRegressor, image: Tensor) -> Tensor:
    prediction = system.train()(image)
    return prediction.position_m.sum() + prediction.quaternion.sum()


def _kept_for_backward(system: LitPoseRegressor, image: Tensor) -> int:
    """Bytes of the tensors that the forward pass keeps, weights left out."""
    weights = {p.untyped_storage().data_ptr() for p in system.parameters()}
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in weights:
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        loss = _loss(system, image)
    del loss
    return sum(kept.values())


def _kernels(step: object, device: torch.device, shown: int = 8) -> list[tuple[str, float]]:
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # it calls a missing GPU an error, on stderr
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if device.type == "cuda" else [])]
    with profile(activities=activities) as profiled:
        step()  # type: ignore[operator]
    if device.type == "cuda":  # a kernel's row, not that of the operation that launched it
        events = [e for e in profiled.key_averages() if e.device_type != DeviceType.CPU and not e.is_user_annotation]
        times = [(event.key, event.self_device_time_total) for event in events]
    else:
        times = [(event.key, event.self_cpu_time_total) for event in profiled.key_averages()]
    total = sum(taken for _, taken in times)
    return [(name, taken / total) for name, taken in sorted(times, key=lambda pair: -pair[1])[:shown]]
