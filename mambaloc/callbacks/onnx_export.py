"""An ONNX file, or a whole bundle for apps, at the end of every training."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import lightning as L

from mambaloc.errors import InputError
from mambaloc.evaluation.with_map import RUN_MAP
from mambaloc.export import contract_of_training, export_onnx, write_bundle
from mambaloc.models import Checkpoint, LitPoseRegressor
from mambaloc.uncertainty import fit_uncertainty

_log = logging.getLogger(__name__)


class OnnxExport(L.Callback):
    """Export the best epoch's network, checked against PyTorch, to ``RUN/model.onnx``; or to a bundle, with the map.

    Args:
        enabled: whether to.
        bundle: write ``RUN/bundle`` in place of ``RUN/model.onnx``: the model, the run's map, and test vectors, as
            ``mambaloc export`` does. A resumed run replaces it.
    """

    def __init__(self, enabled: bool = True, bundle: bool = False) -> None:
        self.enabled, self.bundle = enabled, bundle

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Export; the last epoch where no best one was kept."""
        if not self.enabled or trainer.fast_dev_run or not trainer.is_global_zero:  # type: ignore[attr-defined]
            return
        assert isinstance(pl_module, LitPoseRegressor)
        best = getattr(trainer.checkpoint_callback, "best_model_path", "")
        run = Path(trainer.default_root_dir)
        system = Checkpoint.read(best).system() if best else pl_module
        data = trainer.datamodule  # type: ignore[attr-defined]
        if self.bundle:
            shutil.rmtree(run / "bundle", ignore_errors=True)
            found = run / RUN_MAP if (run / RUN_MAP).is_file() else None
            written = write_bundle(system, data, run / "bundle", ("onnx",), sparse_map=found)
            model = written.deviations[0]
            content = "model and map" if found else "model alone"
            _log.info(
                f"{run / 'bundle'}: {content}. The model is within {model.position_mm:.1e} mm and "
                f"{model.rotation_deg:.1e} deg of PyTorch{'.' if written.unsure is None else f'; {written.unsure}'}"
            )
            return
        path = run / "model.onnx"
        try:
            uncertainty, outcome = fit_uncertainty(system, data), "with uncertainty."
        except InputError as error:
            uncertainty, outcome = None, f"without uncertainty: {error}"
        parity = export_onnx(system, path, contract_of_training(system, data, uncertainty), uncertainty)
        _log.info(f"{path}: within {parity.position_m:.1e} m and {parity.rotation_deg:.1e} deg of PyTorch, {outcome}")
