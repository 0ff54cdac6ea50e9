"""The progress bar, with errors as a person reads them."""

from __future__ import annotations

import lightning as L
from lightning.pytorch.callbacks import RichProgressBar


class PoseProgressBar(RichProgressBar):
    """Rich progress bar that shows the latest validation medians in metres and degrees."""

    def get_metrics(
        self, trainer: L.Trainer, pl_module: L.LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """Show the training loss and the medians over the validation set."""
        metrics = trainer.callback_metrics
        shown: dict[str, int | str | float | dict[str, float]] = {}
        if "train/loss" in metrics:
            shown["loss"] = f"{metrics['train/loss'].item():.3f}"
        if "val/position_error_m" in metrics:
            medians = metrics["val/position_error_m"].item(), metrics["val/rotation_error_deg"].item()
            shown["val"] = "{:.3f} m {:.2f} deg".format(*medians)
        return shown
