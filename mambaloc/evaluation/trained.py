"""A trained system and the scene that it is measured in."""

from __future__ import annotations

from dataclasses import dataclass

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.models import Checkpoint, LitPoseRegressor

_GIS = {"gis": "with GIS", "classical": "with classical Mamba", "none": "without GIS"}


@dataclass(frozen=True)
class Trained:
    """A trained system, and the scene that it is measured in; :func:`load_trained` makes it."""

    checkpoint: Checkpoint
    system: LitPoseRegressor
    data: PoseDataModule

    @property
    def name(self) -> str:
        """Which system, and its GIS."""
        return f"{self.system.registry_name} {_GIS[self.system.hparams['gis']]}"

    @property
    def chosen(self) -> str:
        """How its epoch was chosen, in a word or two."""
        return self.checkpoint.selection.split(":")[0]

    @property
    def run(self) -> str:
        """Which epoch of which run."""
        return f"{self.chosen} epoch, seed {self.checkpoint.provenance.get('seed')}"


def load_trained(checkpoint: Checkpoint, data: PoseDataModule | None = None) -> Trained:
    """Build the system of a checkpoint for frames.

    Args:
        checkpoint: of a training.
        data: the frames; those of the training unless given.

    Raises:
        InputError: where its model is not registered, or for data whose crops the network was not built for.
    """
    system, data = checkpoint.system(), data or checkpoint.scene_data()
    if data.crop != system.image_size:
        sizes = f"{checkpoint.path} was trained on {system.image_size}"
        raise InputError(f"data.image_size {data.crop}: {sizes}; use that")
    return Trained(checkpoint, system, data)
