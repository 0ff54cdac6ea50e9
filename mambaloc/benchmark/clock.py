"""Seconds of each part of a training step."""

from __future__ import annotations

import time
from typing import Any

import lightning as L
import torch

PARTS = ("load", "augment", "forward", "loss", "backward", "optimiser", "trainer")


class StepClock:
    """Seconds of each part of each step: on a CPU those that the process computes, on a GPU those of a clock.

    Args:
        device: where the steps run.
    """

    def __init__(self, device: torch.device) -> None:
        self.parts_s: dict[str, list[float]] = {part: [] for part in PARTS}
        self._device, self._step, self._last = device, dict.fromkeys(PARTS, 0.0), _spent(device)

    def mark(self, part: str) -> None:
        """What lies since the last mark was this part."""
        at = _spent(self._device)
        self._step[part] += at - self._last
        self._last = at

    def end_step(self) -> None:
        """Begin the next step."""
        for part in PARTS:
            self.parts_s[part].append(self._step[part])
            self._step[part] = 0.0


class TrainerClock(L.Callback):
    """The clock of the steps of a Trainer."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start, and listen where batches are augmented and the loss is computed."""
        data, clock = trainer.datamodule, StepClock(pl_module.device)  # type: ignore[attr-defined]
        augment = data.on_after_batch_transfer

        def timed(*args: Any) -> Any:
            clock.mark("load")
            batch = augment(*args)
            clock.mark("augment")
            return batch

        data.on_after_batch_transfer = timed
        self._hooks = [
            pl_module.loss.register_forward_pre_hook(lambda *_: clock.mark("forward")),  # type: ignore[union-attr]
            pl_module.loss.register_forward_hook(lambda *_: clock.mark("loss")),  # type: ignore[union-attr]
        ]
        self.clock = clock

    def on_train_batch_start(self, *_: Any) -> None:
        """A batch is ready."""
        self.clock.mark("trainer")

    def on_before_backward(self, *_: Any) -> None:
        """The loss is known."""
        self.clock.mark("trainer")

    def on_after_backward(self, *_: Any) -> None:
        """Gradients are known."""
        self.clock.mark("backward")

    def on_train_batch_end(self, *_: Any) -> None:
        """Weights are changed."""
        self.clock.mark("optimiser")
        self.clock.end_step()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop listening."""
        del trainer.datamodule.on_after_batch_transfer  # type: ignore[attr-defined]
        for hook in self._hooks:
            hook.remove()


def now(device: torch.device) -> float:
    """Seconds on a clock, once the device has finished its queue."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _spent(device: torch.device) -> float:
    return now(device) if device.type == "cuda" else time.process_time()
