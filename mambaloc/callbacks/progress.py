"""The progress bar, with errors as a person reads them."""

from __future__ import annotations

import time
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import RichProgressBar

_DRAWN_EVERY_S = 0.1


class PoseProgressBar(RichProgressBar):
    """Rich progress bar that shows the latest validation medians in metres and degrees, drawn ten times a second.

    Under a time budget it also shows the seconds left.
    """

    _drawn_s = 0.0

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Draw, unless that was done just now: it takes longer than a fast step, and reading a loss waits for a GPU."""
        now = time.monotonic()
        if now - self._drawn_s >= _DRAWN_EVERY_S or batch_idx + 1 == trainer.num_training_batches:
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
            self._drawn_s = now

    def get_metrics(
        self, trainer: L.Trainer, pl_module: L.LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """Show the training loss and the medians over the validation set."""
        metrics = trainer.callback_metrics
        shown: dict[str, int | str | float | dict[str, float]] = {}
        if "train/loss" in metrics:
            shown["loss"] = f"{metrics['train/loss'].item():.3f}"
        if "time/left_s" in metrics:
            shown["left"] = f"{max(0.0, metrics['time/left_s'].item()):.0f} s"
        if "val/position_error_m" in metrics:
            medians = metrics["val/position_error_m"].item(), metrics["val/rotation_error_deg"].item()
            shown["val"] = "{:.3f} m {:.2f} deg".format(*medians)
        return shown

    def _get_train_description(self, current_epoch: int) -> str:
        """Name the epoch; Lightning counts up to -2 where ``trainer.max_epochs`` is -1, without a limit."""
        if self.trainer.max_epochs == -1:
            return f"Epoch {current_epoch}".ljust(len(self.validation_description))
        return super()._get_train_description(current_epoch)
