"""What a checkpoint says of the system in it: hyperparameters, data, how its epoch was chosen, provenance."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mambaloc.errors import InputError
from mambaloc.files import sha256
from mambaloc.models.base import BACKBONE_ARGUMENTS, LitPoseRegressor
from mambaloc.models.registry import model_class
from mambaloc.models.weights import build_from, read_checkpoint

if TYPE_CHECKING:
    from mambaloc.data import MultiSceneDataModule, PoseDataModule


_FORMER_AUGMENTATION = ("focal_ratio",)
"""Arguments that ``PoseDataModule`` had: what a checkpoint is measured on does not depend on them."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A training's checkpoint, read once.

    Args:
        path: the file.
        stored: its plain data on the CPU, without the optimizer's state.
    """

    path: Path
    stored: dict[str, Any] = field(repr=False)

    @classmethod
    def read(cls, path: str | Path) -> Checkpoint:
        """Read a file without unpickling it.

        Raises:
            InputError: where the file is missing, unreadable, or holds anything but tensors and plain data.
        """
        stored = read_checkpoint(path)
        stored.pop("optimizer_states", None)  # twice as large as the weights, and only a resumed training reads it
        return cls(Path(path), stored)

    def system(self) -> LitPoseRegressor:
        """Build the trained system, in evaluation mode on the CPU.

        Raises:
            InputError: where its model is not registered.
        """
        return build_from(self.stored, model_class(self.provenance["model"])).eval()

    def data(self, **changed: Any) -> PoseDataModule | MultiSceneDataModule:
        """Build the data module of the training, of one scene or of several.

        Arguments of earlier versions that only augmented training images are left out.

        Args:
            changed: arguments that replace the training's.

        Raises:
            InputError: where the training was given loaders alone.
        """
        from mambaloc.data import build_data  # only here: a network is built without the data's libraries

        stored = self.stored.get("datamodule_hyper_parameters", {})
        arguments = {name: value for name, value in stored.items() if not name.startswith("_")}  # Lightning's notes
        for name in _FORMER_AUGMENTATION:
            arguments.pop(name, None)
        if not arguments:
            raise InputError(f"{self.path}: contains no data settings; train it with mambaloc train")
        return build_data(**{**arguments, **changed})

    def scene_data(self, **changed: Any) -> PoseDataModule:
        """The same, where only one scene will do.

        Raises:
            InputError: as :meth:`data`; where the network knows several scenes.
        """
        data = self.data(**changed)
        if (count := len(data.each_scene())) > 1:
            raise InputError(f"{self.path}: has {count} scenes, but one is expected. Give a checkpoint of one scene.")
        return data.each_scene()[0]

    @property
    def provenance(self) -> dict[str, Any]:
        """Model, commit, versions, device and seed of the training, and its data where it had a data module."""
        return self.stored["mambaloc"]

    @property
    def selection(self) -> str:
        """How this epoch was chosen: a word or two, and for the best one the rule after a colon."""
        states = [state for name, state in self.stored["callbacks"].items() if name.startswith("ModelCheckpoint")]
        monitor = next((state["monitor"] for state in states if state["monitor"]), None)
        if self.path.stem == "last" or monitor is None:
            return "last"
        if self.stored.get("datamodule_hyper_parameters", {}).get("validation") == "test_set":
            return f"best on TEST: lowest {monitor} ON THE TEST SET, so its errors are not those of unseen frames"
        return f"best: lowest {monitor} on frames held out of training"

    @property
    def wall_clock(self) -> dict[str, Any] | None:
        """State of the training's :class:`~mambaloc.callbacks.WallClock`; None where it had none."""
        states = self.stored["callbacks"].items()
        return next((state for name, state in states if name.startswith("WallClock")), None)

    @property
    def backbone_arguments(self) -> dict[str, Any]:
        """Arguments of the backbone that the training started from, as ``mambaloc.nn``'s backbones take them.

        None for those that the system does not have.
        """
        stored = self.stored["hyper_parameters"]
        return {theirs: stored.get(ours) for theirs, ours in BACKBONE_ARGUMENTS.items()}

    @cached_property
    def sha256(self) -> str:
        """Digest of the file."""
        return sha256(self.path)

    def describe(self) -> dict[str, Any]:
        """Provenance, epoch, step and seconds of the training, its recipe's digest and the file's."""
        recipe = self.path.parent.parent / "config.yaml"
        return {
            **self.provenance,
            "epoch": self.stored["epoch"] + 1,
            "step": self.stored["global_step"],
            "wall_clock": self.wall_clock,
            "recipe": str(recipe) if recipe.is_file() else None,
            "recipe_sha256": sha256(recipe) if recipe.is_file() else None,
            "checkpoint": str(self.path),
            "checkpoint_sha256": self.sha256,
        }
