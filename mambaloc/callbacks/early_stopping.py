"""The paper's early stopping."""

from __future__ import annotations

import lightning as L
from lightning.pytorch import callbacks


class EarlyStopping(callbacks.EarlyStopping):
    """Stop when the validation loss has not fallen for ``patience`` epochs (five in the paper).

    Without a validation set it never stops.

    Args:
        monitor: a validation metric that should fall.
        patience: epochs without a new lowest value, or validations where validation is not once an epoch; 0 never
            stops.
        min_delta: how much lower counts.
    """

    def __init__(self, monitor: str = "val/loss", patience: int = 5, min_delta: float = 0.0) -> None:
        super().__init__(monitor, patience=patience, min_delta=min_delta, mode="min")

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Compare this epoch's value with the lowest."""
        if self.patience and self.monitor in trainer.callback_metrics:
            super().on_train_epoch_end(trainer, pl_module)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Check after a validation, where it does not run once an epoch."""
        if self.patience:
            super().on_validation_end(trainer, pl_module)
