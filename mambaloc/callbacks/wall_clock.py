"""Training seconds, apart from set-up and validation."""

from __future__ import annotations

import time
from typing import Any

import lightning as L
import torch

from mambaloc.errors import InputError

MEDIANS = ("position_error_m", "rotation_error_deg")


class WallClock(L.Callback):
    """Clock set-up, training and validation apart, and how long training took to reach a given error.

    Training seconds leave out set-up, validation, checkpoints and export. The clock survives a resume: a
    checkpoint holds it, with ``history``: the medians of each validation and the training seconds before it, and with
    ``began_at``: the time of day, in seconds, at which the first step began. On an accelerator it waits for the device
    before each reading.

    Args:
        reach: validation medians, such as ``{"position_error_m": 0.2, "rotation_error_deg": 10}``; the training
            seconds after which all were first reached are recorded.
    """

    def __init__(self, reach: dict[str, float] | None = None) -> None:
        self.reach = reach or {}
        self.seconds = {"setup_s": 0.0, "train_s": 0.0, "validation_s": 0.0}
        self.reached_s: float | None = None
        self.history: list[dict[str, float]] = []
        self.began_at: float | None = None
        self._last = time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        """Return the readings so far."""
        readings = {"reached_s": self.reached_s, "history": self.history, "began_at": self.began_at}
        return {**self.seconds, "reach": dict(self.reach), **readings}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a checkpoint's readings, adding this process's own set-up."""
        self.seconds = {name: state_dict[name] for name in self.seconds}
        self.reached_s = state_dict["reached_s"]
        self.history = list(state_dict.get("history", []))  # older checkpoints have none
        self.began_at = state_dict.get("began_at")

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """End set-up."""
        self._lap(pl_module, "setup_s")
        self.began_at = self.began_at or time.time()

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the epoch timer. Time between epochs is not counted."""
        self._lap(pl_module, None)

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Pause training."""
        if not trainer.sanity_checking:
            self._lap(pl_module, "train_s")

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Go on with training, and see whether the error sought is reached."""
        if trainer.sanity_checking:
            return
        self._lap(pl_module, "validation_s")
        metrics = trainer.callback_metrics
        medians = {name: float(metrics[f"val/{name}"]) for name in MEDIANS if f"val/{name}" in metrics}
        self.history.append({"train_s": self.seconds["train_s"], "step": trainer.global_step, **medians})
        if self.reach and self.reached_s is None:
            for name in self.reach:
                if f"val/{name}" not in metrics:
                    raise InputError(f"wall_clock.reach: no validation metric {name!r}; try position_error_m")
            if all(metrics[f"val/{name}"] <= sought for name, sought in self.reach.items()):
                self.reached_s = self.seconds["train_s"]

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """End an epoch."""
        self._lap(pl_module, "train_s")
        pl_module.log("time/train_s", self.seconds["train_s"], sync_dist=True)

    def _lap(self, pl_module: L.LightningModule, name: str | None) -> None:
        if pl_module.device.type == "cuda":
            torch.cuda.synchronize(pl_module.device)
        now = time.perf_counter()
        if name is not None:
            self.seconds[name] += now - self._last
        self._last = now
