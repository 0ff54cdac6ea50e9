"""An ONNX file at the end of every training."""

from __future__ import annotations

from pathlib import Path

import lightning as L
from lightning.pytorch.utilities import rank_zero_info

from mambaloc.errors import InputError
from mambaloc.export import contract_of, export_onnx
from mambaloc.models import Checkpoint, LitPoseRegressor
from mambaloc.uncertainty import fit_uncertainty


class OnnxExport(L.Callback):
    """Export the best epoch's network, checked against PyTorch, to ``RUN/model.onnx``.

    Args:
        enabled: whether to.
    """

    def __init__(self, enabled: bool = True) -> None:
        self.enabled = enabled

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Export; the last epoch where no best one was kept."""
        if not self.enabled or trainer.fast_dev_run or not trainer.is_global_zero:  # type: ignore[attr-defined]
            return
        assert isinstance(pl_module, LitPoseRegressor)
        best = getattr(trainer.checkpoint_callback, "best_model_path", "")
        path = Path(trainer.default_root_dir) / "model.onnx"
        system = Checkpoint.read(best).system() if best else pl_module
        data = trainer.datamodule  # type: ignore[attr-defined]
        try:
            uncertainty, told = fit_uncertainty(system, data), "tells how sure it is"
        except InputError as error:
            uncertainty, told = None, f"tells no uncertainty: {error}"
        parity = export_onnx(system, path, contract_of(system, data.hparams, uncertainty), uncertainty)
        rank_zero_info(f"{path}: within {parity.position_m:.1e} m and {parity.rotation_deg:.1e} deg of PyTorch; {told}")
