"""A run's folder that is somewhere else than it was: moved, copied, mounted elsewhere, or named by another path."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import ModelCheckpoint


class MovedRun(L.Callback):
    """Update the checkpoint paths of a resumed run's callbacks, before they read the old ones.

    Lightning's ``ModelCheckpoint`` compares both places as text. Where they differ it forgets the best score so far,
    and replaces the best checkpoint by that of the next epoch.
    """

    def on_load_checkpoint(self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]) -> None:
        """Change the folder in the state of each ``ModelCheckpoint`` whose best checkpoint is in its new folder."""
        for callback in trainer.checkpoint_callbacks:
            state = checkpoint.get("callbacks", {}).get(callback.state_key)
            if isinstance(callback, ModelCheckpoint) and state and callback.dirpath:
                checkpoint["callbacks"][callback.state_key] = _moved(state, str(callback.dirpath))


def _moved(state: dict[str, Any], folder: str) -> dict[str, Any]:
    """The state of a ``ModelCheckpoint`` with its folder changed; as it is where the best checkpoint did not come."""
    before = str(state.get("dirpath", folder))

    def now(path: str) -> str:
        return os.path.join(folder, os.path.relpath(path, before)) if path else ""  # noqa: PTH118  Lightning's text

    paths = {name: now(state[name]) for name in ("best_model_path", "kth_best_model_path", "last_model_path")}
    if paths["best_model_path"] and not Path(paths["best_model_path"]).is_file():
        return state
    best = {now(path): score for path, score in state["best_k_models"].items()}
    return {**state, **paths, "best_k_models": best, "dirpath": folder}
