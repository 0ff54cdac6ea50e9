"""Watch the validation trajectory while training."""

from __future__ import annotations

from pathlib import Path

import lightning as L

from mambaloc.data import MultiSceneDataModule
from mambaloc.models import LitPoseRegressor
from mambaloc.viz.trajectory import draw_trajectory


class TrajectoryPlot(L.Callback):
    """Draw the validation frames' true and predicted trajectory to ``RUN/validation.png``.

    Args:
        every_n_epochs: how often; 0 never.
    """

    def __init__(self, every_n_epochs: int = 10) -> None:
        self.every_n_epochs = every_n_epochs

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw, where this epoch's turn has come."""
        due = self.every_n_epochs and (trainer.current_epoch + 1) % self.every_n_epochs == 0
        if not due or trainer.sanity_checking or trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        assert isinstance(pl_module, LitPoseRegressor)
        if isinstance(trainer.datamodule, MultiSceneDataModule):  # type: ignore[attr-defined]
            return  # their frames have no frame of reference in common
        table = pl_module.val_errors.table()  # on every rank: it gathers
        if trainer.is_global_zero:
            sequences = trainer.datamodule.frames("val").sequences  # type: ignore[attr-defined]
            path = Path(trainer.default_root_dir) / "validation.png"
            draw_trajectory(table, sequences, path, f"validation, epoch {trainer.current_epoch + 1}")
