"""From a scene's folder to augmented batches on the device."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.fabric.utilities import move_data_to_device
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, DistributedSampler

from mambaloc import provenance
from mambaloc.data.augmentation import Jitter, RandomCrop, RandomRotation, View, centered, draw_uniforms
from mambaloc.data.cameras import undistortion_of
from mambaloc.data.datasets.capture import world_of
from mambaloc.data.frame_dataset import CachedFrames
from mambaloc.data.frames import Frames, OnBadFrame, Split
from mambaloc.data.scene import Scene
from mambaloc.data.splits import Validation
from mambaloc.data.views import FramesAndViews, MixedSampler, SceneViews, ViewDepth, points_of_views
from mambaloc.errors import InputError
from mambaloc.geometry import cropped_intrinsics
from mambaloc.images import center_corner
from mambaloc.runtime.rotations import matrix_from_quaternion, rigid_transforms
from mambaloc.runtime.undistortion import Undistortion
from mambaloc.runtime.world import World
from mambaloc.synthesis import Views
from mambaloc.types import PoseBatch


class PoseDataModule(L.LightningDataModule):
    """A scene's training, validation and test frames.

    Args:
        dataset: ``7scenes``, ``cambridge``, ``embedded``: the generated room, or ``capture``: an imported scene.
        root: folder that holds the scenes; the dataset's own default unless given.
        scene: folder of the scene under ``root``; or an imported scene's path, whatever the other two say.
        image_size: side of the square crop, or (height, width), in pixels.
        short_side: what the shorter side of every image is resized to, in pixels.
        batch_size: training images, or clips, a step, per device.
        eval_batch_size: images a step of validation and test.
        num_workers: loader processes; frames come from a memory map, so none is often fastest. None are started for
            frames that are resident.
        resident: keep decoded frames whole in the device's memory; unless given, on a GPU whose free memory they fill
            by half at most. On a CPU the memory map, which the operating system keeps, is as fast.
        brightness: range of that jitter factor, ``[1 - x, 1 + x]``.
        contrast: the same of that factor.
        saturation: the same of that factor.
        augmentation: each training image's view. ``crop``, the paper's: a random crop, which is asked for the frame's
            pose. ``rotation``: what a camera turned about its centre sees, whose pose is known exactly.
        rotation_deg: under ``rotation``, turns are uniform within so much, about each of the camera's axes.
        zoom: under ``rotation``, focal lengths vary from ``1 / (1 + zoom)`` to ``1 + zoom`` times the frame's.
        augmentation_draws: augment each training image in so many ways, one an epoch in turn, in place of a new way
            every epoch: features of frozen layers can then be kept.
        validation: how the best epoch is chosen, see :data:`~mambaloc.data.splits.Validation`; ``test_set`` selects on
            the test set and is reported as such.
        val_fraction: share of the training frames that is held out.
        val_gap: frames dropped between a held-out block and training frames.
        val_sequences: sequences to hold out, by name; with ``validation: block``, those whose ends to hold out.
        keep_every: train on every k-th frame of each sequence (sparsity 1/k).
        keep_count: train on so many frames, uniform in time, instead.
        clip_length: train on clips of so many frames of a sequence, as MapNet does.
        clip_skip: frames from one of a clip to the next, counted before thinning.
        points_per_frame: scene points that training and validation frames carry, from depth frames,
            ``reconstruction.nvm`` or a COLMAP model in the scene's folder; 0 reads none. Where there are views, they
            come from the depth that these are made from.
        views: how many synthetic views to train on beside the frames; 0 makes none.
        view_depth: what they are made from. ``sensor``: depth frames of training frames; ``pictures``: depth that a
            plane sweep finds in them; ``auto``: the sensor's where enough training frames have some.
        view_share: share of views in each training batch; three in four, or none where views of held-out training
            frames do not match these, unless given. An epoch is a pass over the frames.
        on_bad_frame: ``error`` stops at a bad frame; ``skip`` leaves it out and counts it.
        cache_dir: where decoded frames are kept; ``$MAMBALOC_CACHE`` or the user's cache folder unless given.
    """

    def __init__(
        self,
        dataset: str = "7scenes",
        root: str | None = None,
        scene: str = "heads",
        image_size: int | tuple[int, int] = 224,
        short_side: int = 256,
        batch_size: int = 8,
        eval_batch_size: int = 32,
        num_workers: int = 0,
        resident: bool | None = None,
        brightness: float = 0.3,
        contrast: float = 0.3,
        saturation: float = 0.3,
        augmentation: View = "crop",
        rotation_deg: float = 10.0,
        zoom: float = 0.0,
        augmentation_draws: int | None = None,
        validation: Validation = "auto",
        val_fraction: float = 0.1,
        val_gap: int = 20,
        val_sequences: list[str] | None = None,
        keep_every: int = 1,
        keep_count: int | None = None,
        clip_length: int = 1,
        clip_skip: int = 10,
        points_per_frame: int = 0,
        views: int = 0,
        view_depth: ViewDepth = "auto",
        view_share: float | None = None,
        on_bad_frame: OnBadFrame = "error",
        cache_dir: str | None = None,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        for several in ("scenes", "scene_share"):  # of a recipe's data; this is one scene
            self.hparams.pop(several, None)
        self.scene = Scene(**{field.name: self.hparams[field.name] for field in fields(Scene)})
        # LightningCLI has given what the recipe says; what is kept and described is what that means.
        self.hparams.update(dataset=self.scene.dataset, root=self.scene.root, scene=self.scene.scene)
        self.crop = self.scene.crop
        self.jitter = Jitter(brightness, contrast, saturation)
        rotation = RandomRotation(self.crop, rotation_deg, zoom)
        ways: dict[str, RandomCrop | RandomRotation] = {"crop": RandomCrop(self.crop), "rotation": rotation}
        if augmentation not in ways:
            raise InputError(f"data.augmentation {augmentation!r}: choose one of {', '.join(ways)}")
        self.augmentation = ways[augmentation]
        if augmentation_draws is not None and augmentation_draws < 1:
            raise InputError(f"data.augmentation_draws {augmentation_draws}: must be 1 or more, or null")
        self.scene_index: int | None = None  # among those of a MultiSceneDataModule
        self._resident: dict[Split, CachedFrames] = {}
        self._uniforms: tuple[tuple[int, int, torch.device], Tensor] | None = None

    @property
    def folder(self) -> Path:
        """The scene's folder."""
        return self.scene.folder

    @property
    def world(self) -> World:
        """Where the scene's frame lies in the world of the data that it was made of."""
        return world_of(self.folder)

    @property
    def undistortion(self) -> Undistortion:
        """How the scene's images were made of what their camera stored."""
        return undistortion_of(self.folder)

    def each_scene(self) -> list[PoseDataModule]:
        """This scene's data module: :class:`~mambaloc.data.MultiSceneDataModule` has several."""
        return [self]

    def setup(self, stage: str) -> None:
        """Read and decode what a stage needs; every process may, since only one builds the cache."""
        if stage in ("fit", "validate"):
            self.scene.load_training()
        if stage in ("test", "predict"):
            self.scene.load_test()

    @property
    def train_position_m(self) -> Tensor:
        """Positions of the training frames, (N, 3)."""
        return self.scene.parts["train"].data.position_m

    @property
    def train_intrinsics(self) -> Tensor:
        """Pinhole matrices of the training frames' centre crops, (N, 3, 3), in pixels."""
        data = self.scene.parts["train"].data
        return cropped_intrinsics(data.intrinsics, *center_corner(data.images.shape[-2:], self.crop))

    def listed_training_frames(self) -> Frames:
        """Read the whole training split's poses, without decoding an image.

        Raises:
            InputError: if the scene has no training frame.
        """
        return self.scene.read("train")[0]

    def chosen_training_frames(self) -> Frames:
        """Read the poses of those training frames that are neither held out nor thinned away, without an image.

        Raises:
            InputError: if the scene has no training frame.
        """
        return self.scene.choose()[0][0]

    @property
    def scene_views(self) -> SceneViews | None:
        """Views of the training frames, and how good they are, once training batches were asked for."""
        return self.scene.made_views

    @property
    def view_rows(self) -> NDArray[np.int64]:
        """Rows of the training images, as ``PoseBatch.index`` has them, that are views."""
        data = self.scene.items("train")
        return np.arange(len(data.frames), len(data.clips)) if isinstance(data, FramesAndViews) else np.arange(0)

    def replace_views(self, rows: NDArray[np.int64], views: Views) -> None:
        """Train on N views in place of those in N of the :attr:`view_rows`, from the next batch on."""
        frames = self.scene.items("train")
        count = 0 if frames.points_m is None else frames.points_m.shape[1]
        points = points_of_views(views, count, provenance.seed()) if count else None
        for data in {id(each): each for each in (frames, self._data("train"))}.values():  # the device's copy, too
            if isinstance(data, FramesAndViews):
                data.replace_views(rows, views, points)

    def training_batches(self, rows: NDArray[np.int64], epoch: int, size: int) -> Iterator[PoseBatch]:
        """Training images of some rows, ``size`` a batch, as the training sees them in an epoch."""
        data = self._data("train")
        for start in range(0, len(rows), size):
            batch = data.__getitems__(rows[start : start + size].tolist())
            yield self.augmented(move_data_to_device(batch, self._device), epoch)

    def poses_of_rows(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Poses ``world_from_cam`` of some training images, views among them, (N, 4, 4)."""
        data = self.scene.items("train")
        return rigid_transforms(
            matrix_from_quaternion(data.quaternion[rows].double().cpu().numpy()),
            data.position_m[rows].double().cpu().numpy(),
        )

    def frames(self, part: Split) -> Frames:
        """Return the frames of a part, in the order of ``PoseBatch.index``."""
        return self.scene.parts[part].data.frames

    def describe(self) -> dict[str, Any]:
        """Say which frames a number comes from: scene, counts, selection rule, what was left out and repaired."""
        return self.scene.describe()

    def training_key(self) -> str:
        """Name what augmented training images depend on: frames, views, chances and the batches they are mixed in."""
        settings = (
            self.scene.training_key(),
            self.augmentation,
            self.jitter,
            provenance.seed(),
            self.hparams["batch_size"],
        )
        return hashlib.sha256(repr(settings).encode()).hexdigest()

    def train_dataloader(self) -> DataLoader[PoseBatch]:
        """Shuffled training batches; the first call makes views."""
        self.scene.add_views(self._device)
        return self._loader("train", self.hparams["batch_size"], shuffle=True)

    def val_dataloader(self) -> DataLoader[PoseBatch] | list[Any]:
        """Validation batches in order; none under ``validation: none``."""
        if self.hparams["points_per_frame"]:
            self.scene.add_views(self._device)
        return self._loader("val", self.hparams["eval_batch_size"]) if "val" in self.scene.parts else []

    def test_dataloader(self) -> DataLoader[PoseBatch]:
        """Test batches in order."""
        return self._loader("test", self.hparams["eval_batch_size"])

    def predict_dataloader(self) -> DataLoader[PoseBatch]:
        """Test batches in order, for predictions without errors."""
        return self.test_dataloader()

    def batches(self, part: Split, rows: Sequence[int] | None = None, size: int | None = None) -> Iterator[PoseBatch]:
        """Frames of a part as validation and test see them, centre-cropped and one by one, on the CPU.

        Args:
            part: of those that are set up.
            rows: of :meth:`frames`; all by default.
            size: frames a batch; ``eval_batch_size`` unless given.
        """
        loaded, size = self.scene.parts[part].data, size or self.hparams["eval_batch_size"]
        frames = CachedFrames(loaded.frames, loaded.images, loaded.cameras, loaded.points)  # no clips
        rows = range(len(frames)) if rows is None else rows
        for start in range(0, len(rows), size):
            yield self._of_scene(centered(frames.__getitems__(list(rows[start : start + size])), self.crop))

    def on_after_batch_transfer(self, batch: PoseBatch, dataloader_idx: int) -> PoseBatch:
        """Crop on the device; while training, augment. Intrinsics follow, and the pose where the camera turns."""
        if self.trainer is None or not self.trainer.training:
            return self._of_scene(centered(batch, self.crop))
        return self._of_scene(self.augmented(batch, self.trainer.current_epoch))

    def _of_scene(self, batch: PoseBatch) -> PoseBatch:
        """Say which scene the images show, where it is one of several."""
        return (
            batch if self.scene_index is None else replace(batch, scene=torch.full_like(batch.index, self.scene_index))
        )

    def augmented(self, batch: PoseBatch, epoch: int) -> PoseBatch:
        """View and colour training images as chance has it, which depends on (seed, epoch, row) alone."""
        if draws := self.hparams["augmentation_draws"]:
            epoch %= draws
        uniform = self._epoch_uniforms(epoch, batch.index.device)[batch.index]
        view, color = uniform.tensor_split([self.augmentation.draws], dim=1)
        return self.augmentation(batch, self.jitter.matrices(batch.image, color), view)

    def _epoch_uniforms(self, epoch: int, device: torch.device) -> Tensor:
        """An epoch's chances of every training frame, drawn and sent to the device once."""
        drawn_for = (provenance.seed(), epoch, device)
        if self._uniforms is None or self._uniforms[0] != drawn_for:
            rows, draws = len(self.scene.items("train").position_m), self.augmentation.draws + self.jitter.draws
            uniforms = draw_uniforms(provenance.seed(), epoch, rows, draws)
            self._uniforms = (drawn_for, uniforms.to(device))
        return self._uniforms[1]

    def _loader(self, part: Split, batch_size: int, shuffle: bool = False) -> DataLoader[PoseBatch]:
        data, trainer = self._data(part), self.trainer
        workers = 0 if data.resident is not None else self.hparams["num_workers"]
        # One kind of sampler everywhere: Lightning gives it the epoch, so order depends on (seed, epoch) alone.
        sampler: DistributedSampler[Any]
        replicas, rank = (trainer.world_size, trainer.global_rank) if trainer else (1, 0)
        if isinstance(data, FramesAndViews):
            sampler = MixedSampler(data, batch_size, replicas, rank, provenance.seed())
        else:
            sampler = DistributedSampler(data, replicas, rank, shuffle, provenance.seed())
        if trainer and shuffle:
            # A resumed fit fetches its first batch before Lightning tells the sampler which epoch it is.
            sampler.set_epoch(trainer.fit_loop.epoch_progress.current.processed)  # type: ignore[attr-defined]
        return DataLoader(
            data,
            batch_size=batch_size,  # by name: Lightning makes this loader again to predict
            sampler=sampler,
            num_workers=workers,
            collate_fn=_as_fetched,  # type: ignore[arg-type]
            pin_memory=torch.cuda.is_available() and data.resident is None,
            persistent_workers=workers > 0,
        )

    @property
    def _device(self) -> torch.device:
        return self.trainer.strategy.root_device if self.trainer else torch.device("cpu")

    def _data(self, part: Split) -> CachedFrames:
        """A part's frames, in the device's memory if they are to be there."""
        data, resident, device = self.scene.items(part), self._resident.get(part), self._device
        if resident is not None and resident.position_m.device == device:
            return resident
        wanted = self.hparams["resident"]
        if wanted is None:
            needed = sum(self.scene.items(each).nbytes for each in self.scene.parts if each not in self._resident)
            wanted = device.type == "cuda" and 2 * needed <= torch.cuda.mem_get_info(device)[0]
        if not wanted:
            return data
        self._resident[part] = data.to(device)
        return self._resident[part]


def _as_fetched(batch: PoseBatch) -> PoseBatch:
    """Keep a batch that came whole from ``__getitems__``; a named function, since workers pickle it."""
    return batch
