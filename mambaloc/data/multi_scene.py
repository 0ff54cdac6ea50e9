"""Several scenes for one network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import lightning as L
import torch
from lightning.pytorch.utilities import CombinedLoader
from torch import Tensor
from torch.utils.data import DataLoader

from mambaloc.data.datamodule import PoseDataModule
from mambaloc.data.datasets.registry import DATASETS
from mambaloc.errors import InputError
from mambaloc.runtime.world import World
from mambaloc.types import PoseBatch, height_and_width

SceneShare = Literal["equal", "size"]
"""How many of a batch's images each scene gives: as many as any other, or more where it has more training frames."""


class MultiSceneDataModule(L.LightningDataModule):
    """Several scenes for one network; every training batch has images of each.

    Each scene keeps what it has alone: its frame of reference, its split, its views and its cameras. It is a
    :class:`PoseDataModule`, and :meth:`each_scene` gives them all: what measures or deploys goes scene by scene.

    Args:
        scenes: names of scenes of ``dataset``, ``DATASET/NAME`` of another one, or paths of imported scenes.
        scene_share: ``equal``, or ``size``: by training frames.
        dataset: of scenes that name none, as :class:`PoseDataModule` takes it.
        root: folder that holds the scenes of ``dataset``.
        image_size: of every scene's crop.
        batch_size: training images a step, of all scenes together, per device; at least one of each.
        arguments: :class:`PoseDataModule`'s others, for every scene.

    Raises:
        InputError: for fewer than two scenes, one that is named twice, an unknown share, or more scenes than a batch
            has images.
    """

    def __init__(
        self,
        scenes: list[str],
        scene_share: SceneShare = "equal",
        dataset: str = "7scenes",
        root: str | None = None,
        image_size: int | tuple[int, int] = 224,
        batch_size: int = 8,
        **arguments: Any,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        if len(set(scenes)) < len(scenes) or len(scenes) < 2:
            raise InputError(f"data.scenes {scenes}: must name two scenes or more, each once. For one, set data.scene.")
        if scene_share not in get_args(SceneShare):
            raise InputError(f"data.scene_share {scene_share!r}: choose one of {', '.join(get_args(SceneShare))}")
        if batch_size < len(scenes):
            raise InputError(f"data.batch_size {batch_size}: has no image for some of {len(scenes)} scenes. Give more.")
        self.scenes, self.crop = list(scenes), height_and_width(image_size)
        self._members: list[PoseDataModule] = []

    def each_scene(self) -> list[PoseDataModule]:
        """The data modules of the scenes, in the order of their numbers."""
        if not self._members:
            members = [self._member(index, name) for index, name in enumerate(self.scenes)]
            is_even = self.hparams["scene_share"] == "equal"
            sizes = [1 if is_even else len(each.chosen_training_frames()) for each in members]
            for each, share in zip(members, _shares(sizes, self.hparams["batch_size"]), strict=True):
                each.hparams["batch_size"] = share
            self._members = members  # only now: where a scene cannot be read, none is kept
        return self._members

    def _member(self, index: int, name: str) -> PoseDataModule:
        taken = {"scenes", "scene_share", "dataset", "root", "scene"}
        arguments = {key: value for key, value in self.hparams.items() if key not in taken and key[0] != "_"}
        dataset, _, scene = name.rpartition("/")
        if dataset in DATASETS and not Path(name).is_dir():
            place: dict[str, Any] = {"dataset": dataset, "scene": scene}
        else:
            place = {"dataset": self.hparams["dataset"], "root": self.hparams["root"], "scene": name}
        member = PoseDataModule(**place, **arguments)
        member.scene_index = index
        return member

    def setup(self, stage: str) -> None:
        """Read and decode what a stage needs of every scene."""
        for each in self.each_scene():
            each.trainer = self.trainer
            each.setup(stage)

    def describe(self) -> dict[str, Any]:
        """Say which frames a number comes from, scene by scene."""
        return {"scenes": {name: each.describe() for name, each in zip(self.scenes, self.each_scene(), strict=True)}}

    @property
    def frames_of_reference(self) -> list[tuple[str, World]]:
        """Each scene's name, and where its frame lies in the world of the data that it was made of."""
        return [(name, each.world) for name, each in zip(self.scenes, self.each_scene(), strict=True)]

    def train_dataloader(self) -> CombinedLoader:
        """Shuffled training batches of all scenes: a pass over the one that needs most; the others begin again."""
        return CombinedLoader([each.train_dataloader() for each in self.each_scene()], "max_size_cycle")

    def val_dataloader(self) -> list[DataLoader[PoseBatch]]:
        """Validation batches in order, a loader a scene; none under ``validation: none``."""
        loaders = (each.val_dataloader() for each in self.each_scene())
        return [each for each in loaders if isinstance(each, DataLoader)]

    def test_dataloader(self) -> list[DataLoader[PoseBatch]]:
        """Test batches in order, a loader a scene."""
        return [each.test_dataloader() for each in self.each_scene()]

    def predict_dataloader(self) -> list[DataLoader[PoseBatch]]:
        """Test batches in order, a loader a scene, for predictions without errors."""
        return self.test_dataloader()

    def on_after_batch_transfer(self, batch: PoseBatch | list[PoseBatch], dataloader_idx: int) -> PoseBatch:
        """Crop or augment on the device, each scene its own, and join their parts of a training batch."""
        members = self.each_scene()
        if isinstance(batch, PoseBatch):
            return self._numbered(members[dataloader_idx].on_after_batch_transfer(batch, 0), dataloader_idx)
        parts = [each.on_after_batch_transfer(part, 0) for each, part in zip(members, batch, strict=True)]
        return joined([self._numbered(part, index) for index, part in enumerate(parts)])

    def _numbered(self, batch: PoseBatch, index: int) -> PoseBatch:
        """Number a scene's rows apart from those of the others."""
        return replace(batch, index=batch.index * len(self.scenes) + index)


def joined(parts: list[PoseBatch]) -> PoseBatch:
    """Put batches of one image size together; where only some have points or holes, the others get empty ones."""
    first = parts[0]
    if any(part.clip_length != first.clip_length for part in parts):
        raise ValueError("batches of clips have one length")
    names = ("image", "position_m", "quaternion", "index", "intrinsics", "scene")
    tensors: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    points = max((part.points_m.shape[1] for part in parts if part.points_m is not None), default=0)
    if points:
        tensors["points_m"] = torch.cat([_points_of(part, points) for part in parts])
    if any(part.holes is not None for part in parts):
        shown = [part.image.new_zeros(part.image[:, 0].shape, dtype=torch.bool) for part in parts]
        holes = [none if part.holes is None else part.holes for part, none in zip(parts, shown, strict=True)]
        tensors["holes"] = torch.cat(holes)
    return PoseBatch(**tensors, clip_length=first.clip_length)


def _points_of(part: PoseBatch, count: int) -> Tensor:
    none = part.position_m.new_full((len(part.position_m), count, 3), torch.nan)
    if part.points_m is not None:
        none[:, : part.points_m.shape[1]] = part.points_m
    return none


def _shares(sizes: list[int], batch_size: int) -> list[int]:
    """Share a batch out in proportion to sizes, at least one each: whole numbers that sum to ``batch_size``."""
    shares = [1] * len(sizes)
    for _ in range(batch_size - len(sizes)):  # to whom is owed most, as Jefferson's method has it
        owed = max(range(len(sizes)), key=lambda index: sizes[index] / (shares[index] + 1))
        shares[owed] += 1
    return shares


def build_data(
    scenes: list[str] | None = None, scene_share: SceneShare = "equal", **arguments: Any
) -> PoseDataModule | MultiSceneDataModule:
    """Build the data module of a recipe's ``data``: of one scene, or of several.

    Args:
        scenes: of one network, in place of ``scene``, see :class:`MultiSceneDataModule`.
        scene_share: of each in a batch: ``equal``, or ``size``, by training frames.
        arguments: as :class:`PoseDataModule` takes them.
    """
    if scenes:
        arguments.pop("scene", None)
        return MultiSceneDataModule(scenes, scene_share, **arguments)
    return PoseDataModule(**arguments)
