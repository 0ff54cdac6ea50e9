"""What is measured: a system on a scene, and how it is trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.files import read_yaml
from mambaloc.models import LitPoseRegressor, create_model


@dataclass(frozen=True)
class BenchmarkConfig:
    """A system on a scene, with any setting of a recipe.

    Args:
        system: its name.
        model: arguments of the system.
        data: of :class:`~mambaloc.data.PoseDataModule`.
        trainer: of Lightning's Trainer.
    """

    system: str
    model: Mapping[str, Any] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)
    trainer: Mapping[str, Any] = field(default_factory=dict)

    def with_overlay(self, path: Path) -> BenchmarkConfig:
        """Put what an overlay says over this; it has nothing but these three sections to say.

        Raises:
            InputError: for a file that is not an overlay.
        """
        overlay = read_yaml(path, "see recipes/overlays/", "give an overlay, as recipes/overlays/ holds them")
        if not isinstance(overlay, dict) or not set(overlay) & {"model", "data", "trainer"}:
            raise InputError(f"{path}: sets nothing of model, data or trainer; give one of recipes/overlays/")
        model = _section(path, overlay, "model")
        return replace(
            self,
            model={**self.model, **_section(path, model, "init_args")},
            data={**self.data, **_section(path, overlay, "data")},
            trainer={**self.trainer, **_section(path, overlay, "trainer")},
        )

    def build(self, **data: Any) -> tuple[LitPoseRegressor, PoseDataModule]:
        """Make the system and its scene, whose options ``data`` changes."""
        options = {**self.data, **data}
        image_size = options.get("image_size", 224)
        return create_model(self.system, image_size=image_size, **self.model), PoseDataModule(**options)

    @property
    def device(self) -> torch.device:
        """Where it is trained."""
        return _trainer(self).strategy.root_device

    def fit(self, system: LitPoseRegressor, data: PoseDataModule, callback: L.Callback, **options: Any) -> L.Trainer:
        """Train with this callback alone, and without validation unless asked for."""
        options = {"num_sanity_val_steps": 0, "limit_val_batches": 0, "max_steps": -1, **options}
        trainer = _trainer(self, callbacks=[callback], **options)
        trainer.fit(system, data)
        return trainer


def _section(path: Path, overlay: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    section = overlay.get(name) or {}
    if not isinstance(section, dict) or not all(isinstance(key, str) for key in section):
        raise InputError(f"{path}: {name} is not a mapping. Indent its options below it.")
    return section


def _trainer(setting: BenchmarkConfig, **options: Any) -> L.Trainer:
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    arguments = {
        "accelerator": "cpu",
        "devices": 1,
        **setting.trainer,
        "enable_model_summary": False,
        **quiet,
        **options,
    }
    return L.Trainer(**{"max_epochs": 1, **arguments})
