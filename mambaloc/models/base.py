"""What every system shares: training, validation, testing, optimiser, checkpoints."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Self, get_args

import lightning as L
import torch
import torch.nn.functional as F
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torchmetrics import MeanMetric

from mambaloc import provenance
from mambaloc.errors import InputError
from mambaloc.losses import build_loss
from mambaloc.memory import keep_freed_memory
from mambaloc.metrics import PoseErrors
from mambaloc.models.compiling import CompileMode, compile_forward
from mambaloc.models.feature_cache import FeatureCache
from mambaloc.models.optim import Schedule, build_adam, build_step_schedule, check_span, training_steps
from mambaloc.models.scene_tables import train_rows_only
from mambaloc.models.weights import build_from, read_checkpoint, start_from
from mambaloc.nn import Discretization, GISMode, PoseNetwork, PositionScale, SplitBackbone, recompute_stages
from mambaloc.types import PoseBatch, PosePrediction, height_and_width

BACKBONE_ARGUMENTS = {
    "name": "backbone",
    "weights": "backbone_weights",
    "timm_args": "backbone_args",
    "pixel_mean": "pixel_mean",
    "pixel_std": "pixel_std",
}
"""Arguments of ``mambaloc.nn``'s backbones, and the hyperparameters that set them."""


class LitPoseRegressor(L.LightningModule):
    """Base of every system: a network that maps images to poses, and how it is trained.

    A subclass builds its network in :meth:`configure_network` and registers itself with
    :func:`~mambaloc.models.registry.register_model`. Every hyperparameter is plain (str, number, bool, None, list,
    dict), so that a checkpoint loads without unpickling code.

    Every training step begins with ``torch.manual_seed``, on the seed of ``lightning.seed_everything``, the epoch, the
    step and the rank: a resumed training then continues exactly. It also restarts what a callback draws from torch's
    global generator; a callback that needs numbers of its own keeps a ``torch.Generator``.

    Args:
        image_size: side of the square crop, or (height, width), in pixels; recipes set it once, in ``data``.
        backbone: a timm model.
        backbone_weights: ``timm`` downloads timm's own; otherwise a ``.safetensors`` file; None starts from scratch.
        backbone_args: passed on to timm, for instance ``{"pad_type": "same"}``.
        pixel_mean: RGB mean that the backbone expects, in 0..1; timm's for it unless given.
        pixel_std: RGB standard deviation in 0..1 to normalize with.
        gis: the Global Information Selector of each branch: ``gis``, its ablation ``classical``, or ``none``.
        discretisation: of GIS's state space: ``euler`` or ``zoh``.
        scenes: names of the scenes that one network learns, where there are several; recipes set them in ``data``.
        warm_start: checkpoint of a like network, whose weights the training starts from. Where that knows other scenes,
            those that both know keep their outputs.
        new_scenes_only: train nothing but the outputs of scenes that ``warm_start`` does not know, on frames of all.
            ``denseloc`` then answers in the others as before; queries of ``multi_scene_transposenet`` attend to one
            another, so that new ones change the others' answers.
        loss: name in ``mambaloc.losses.LOSSES``.
        loss_args: that loss's arguments.
        compile_mode: run training steps through ``torch.compile`` in this mode: ``default``, or ``reduce-overhead``,
            which replays CUDA graphs. It takes a minute or so before the first step, and before the first of another
            size, as an epoch's last may be; less where it was done before.
        frozen_groups: layer groups of the backbone, from the image on, that stay as they start, statistics included.
        feature_cache_gib: keep what the frozen groups give for each augmented training image, so much of it at most, in
            a file; the steps then begin after them. It needs ``data.augmentation_draws``. 0 keeps nothing.
        frozen_statistics: normalise by the statistics that the backbone starts with, in all of it: for one trained on
            many more images than the scene has.
        recomputed_stages: first stages of the backbone that a training step computes again in its backward pass: more
            time, the same training, and less memory where the C library gives freed memory back.
        lr: learning rate of Adam, or its highest value.
        beta2: decay of Adam's running mean of squared gradients; a training of few steps may learn faster with 0.99.
        weight_decay: L2 penalty, never on loss weights nor on a state-space mixer's A and D.
        schedule: ``step`` cuts the learning rate; ``cosine`` lets it fall to nothing over the whole training;
            ``one_cycle`` first lets it rise (Smith and Topin 2018). The last two need the training's length.
        lr_step_epochs: under ``step``, epochs between cuts: 100 indoors, 200 outdoors in the paper.
        lr_gamma: what a cut multiplies the learning rate by.
        normalise_position: regress positions relative to the training positions' mean and spread.
    """

    registry_name: ClassVar[str]
    takes_scenes: ClassVar[bool] = False
    """Whether one network can learn several scenes."""

    network: PoseNetwork

    def __init__(
        self,
        image_size: int | tuple[int, int] = 224,
        backbone: str = "resnet34",
        backbone_weights: str | None = None,
        backbone_args: dict[str, Any] | None = None,
        pixel_mean: tuple[float, float, float] | None = None,
        pixel_std: tuple[float, float, float] | None = None,
        gis: GISMode = "none",
        discretisation: Discretization = "euler",
        scenes: list[str] | None = None,
        warm_start: str | None = None,
        new_scenes_only: bool = False,
        loss: str = "learned_weights",
        loss_args: dict[str, Any] | None = None,
        compile_mode: CompileMode | None = None,
        frozen_groups: int = 0,
        feature_cache_gib: float = 0.0,
        frozen_statistics: bool = False,
        recomputed_stages: int = 0,
        lr: float = 1e-4,
        beta2: float = 0.999,
        weight_decay: float = 1e-4,
        schedule: Schedule = "step",
        lr_step_epochs: int = 100,
        lr_gamma: float = 0.1,
        normalise_position: bool = False,
    ) -> None:
        super().__init__()
        self.image_size = height_and_width(image_size)
        self.loss = build_loss(loss, loss_args)
        self.lr, self.weight_decay, self.lr_step_epochs, self.lr_gamma = lr, weight_decay, lr_step_epochs, lr_gamma
        if not 0 <= beta2 < 1:
            raise InputError(f"model.beta2 {beta2:g}: must be 0 or more and less than 1. Adam's usual value is 0.999.")
        self.beta2 = beta2
        if schedule not in get_args(Schedule):
            raise InputError(f"model.schedule {schedule!r}: choose one of {', '.join(get_args(Schedule))}")
        if compile_mode not in (None, *get_args(CompileMode)):
            raise InputError(f"model.compile_mode {compile_mode!r}: choose one of {', '.join(get_args(CompileMode))}")
        if not 0 <= feature_cache_gib < math.inf:
            raise InputError(
                f"model.feature_cache_gib {feature_cache_gib:g}: must be 0 or more, and finite. 0 keeps nothing."
            )
        if feature_cache_gib and compile_mode:
            raise InputError("model.feature_cache_gib: its steps do not run compiled. Set compile_mode to null.")
        if feature_cache_gib and len(scenes or ()) > 1:
            raise InputError("model.feature_cache_gib: keeps features of one scene. Set it to 0 for data.scenes.")
        self.scene_count = max(1, len(scenes or ()))
        if self.scene_count > 1 and not self.takes_scenes:
            name = getattr(self, "registry_name", type(self).__name__)
            raise InputError(
                f"model: {name} learns one scene. For data.scenes choose denseloc or multi_scene_transposenet."
            )
        self.schedule, self.normalise_position, self.compile_mode = schedule, normalise_position, compile_mode
        self._compiled: Callable[..., PosePrediction] | None = None
        self._split: tuple[SplitBackbone, FeatureCache] | None = None
        self.val_errors, self.test_errors = PoseErrors(), PoseErrors()
        self.val_loss = MeanMetric(nan_strategy="disable")  # else NaN would be left out of the mean
        self.provenance: dict[str, Any] = {}
        self.save_hyperparameters()
        self.network = self.configure_network()
        self._new_scenes = list(range(self.scene_count))
        if warm_start is not None:
            known = start_from(self.network, warm_start, scenes or [])
            if new_scenes_only:
                self._new_scenes = [index for index, name in enumerate(scenes or []) if name not in known]
                if not self._new_scenes:
                    raise InputError(
                        "model.new_scenes_only: the checkpoint of warm_start knows all scenes. Add one to data.scenes."
                    )
                train_rows_only(self.network, self._new_scenes)
                self.weight_decay = 0.0  # it would shrink the others' rows
        elif new_scenes_only:
            raise InputError("model.new_scenes_only: needs model.warm_start, a checkpoint that knows the other scenes.")
        if frozen_groups:
            self.network.backbone.freeze(frozen_groups)
        if frozen_statistics:
            self.network.backbone.freeze_statistics()
        if recomputed_stages:
            recompute_stages(self.network.backbone.model, self.network.backbone.name, recomputed_stages)

    def configure_network(self) -> PoseNetwork:
        """Build the network from the hyperparameters: images in, :class:`~mambaloc.types.PosePrediction` out."""
        raise TypeError(f"{type(self).__name__} defines no configure_network()")

    @property
    def backbone_arguments(self) -> dict[str, Any]:
        """The hyperparameters of the backbone, by the names that ``mambaloc.nn``'s backbones have for them.

        ``name`` is the hyperparameter ``backbone``, ``weights`` is ``backbone_weights``, ``timm_args`` is
        ``backbone_args``; ``pixel_mean`` and ``pixel_std`` keep their names.
        """
        return {theirs: self.hparams[ours] for theirs, ours in BACKBONE_ARGUMENTS.items()}

    def hyperparameters_of(self, network: type[nn.Module]) -> dict[str, Any]:
        """Those of this system's hyperparameters that a network class takes, beside its backbone and image size."""
        taken = set(inspect.signature(network).parameters) - {"backbone", "image_size", "scenes"}
        return {name: value for name, value in self.hparams.items() if name in taken}

    def forward(self, image: Tensor, intrinsics: Tensor | None = None, scene: Tensor | None = None) -> PosePrediction:
        """Localize images, (B, 3, H, W) in 0..1, of cameras (B, 3, 3) in their pixels, in given scenes (B,)."""
        return self.network(image, intrinsics, scene)

    def setup(self, stage: str) -> None:
        """Take the scene's position statistics, and compile what the epochs run, before the first epoch.

        Raises:
            InputError: for a class without a name, whose checkpoints nothing could load; where nothing can compile it.
        """
        if stage == "fit" and not hasattr(self, "registry_name"):
            raise InputError(
                f"{type(self).__name__}: has no name, so its checkpoints could not be loaded. "
                "Write @register_model('NAME') above the class."
            )
        if stage == "fit":
            keep_freed_memory()
        if stage == "fit" and self.normalise_position:
            for module in self.network.modules():
                if isinstance(module, PositionScale):
                    scenes = self.scenes_for("normalise_position")
                    for index in self._new_scenes:
                        module.fit(scenes[index].train_position_m, index)
        if stage == "fit" and self.compile_mode is not None:
            accumulated = self.trainer.accumulate_grad_batches
            self._compiled = compile_forward(self.network, self.compile_mode, accumulated)

    def on_train_start(self) -> None:
        """Open the cache of frozen features, now that the training images, views among them, are known."""
        if max_gib := self.hparams["feature_cache_gib"]:
            split = SplitBackbone(self.network.backbone, self.image_size)
            data = self.scene_for("feature_cache_gib")
            self._split = split, FeatureCache.of_training(data, split, self.device, int(max_gib * 2**30))

    def teardown(self, stage: str) -> None:
        """Let go of what only training needs: checkpoints and copies know nothing of it."""
        self._compiled = self._split = None

    def scene_for(self, argument: str) -> Any:
        """Return the trainer's data module, of which an argument asks more than batches.

        Raises:
            InputError: where the trainer was given loaders alone.
        """
        data = getattr(self.trainer, "datamodule", None)
        if data is None:
            raise InputError(f"model.{argument}: needs the scene; give the trainer a PoseDataModule")
        return data

    def scenes_for(self, argument: str) -> list[Any]:
        """Return the data module of each scene, as :meth:`scene_for`."""
        data = self.scene_for(argument)
        return data.each_scene() if self.scene_count > 1 else [data]

    def on_train_epoch_start(self) -> None:
        """Log the learning rate."""
        self.log("train/lr", self.optimizers().param_groups[0]["lr"], sync_dist=True)  # type: ignore[union-attr]

    def on_train_batch_start(self, batch: PoseBatch, batch_idx: int) -> None:
        """Reseed torch's global generator from (seed, epoch, step, rank): dropout then resumes exactly."""
        torch.manual_seed(hash((provenance.seed(), self.current_epoch, batch_idx, self.global_rank)))

    def training_step(self, batch: PoseBatch, batch_idx: int) -> Tensor:
        """Return the loss of a batch; auxiliary heads weigh 0.3 each (Szegedy et al. 2015).

        Poses are those in the true scenes' frames; that of several is recognised, by cross-entropy.
        """
        if self._split is None:
            prediction = (self._compiled or self)(batch.image, batch.intrinsics, batch.scene)
        else:
            split, cache = self._split
            feats = split.trained(cache(batch, self.current_epoch))
            prediction = self.network.forward_head(self.network.features(feats), batch.intrinsics, batch.scene)
        loss = self.loss(prediction, batch)
        for auxiliary in prediction.auxiliary:
            loss = loss + 0.3 * self.loss(auxiliary, batch)
        if prediction.scene_logits is not None and batch.scene is not None:
            loss = loss + F.cross_entropy(prediction.scene_logits, batch.scene)
        self.log("train/loss", loss, on_step=False, on_epoch=True, batch_size=len(batch.index), sync_dist=True)
        return loss

    def on_train_epoch_end(self) -> None:
        """Log the learned loss weights."""
        for name, parameter in self.loss.named_parameters():
            self.log(f"train/{name}", parameter.detach(), sync_dist=True)

    def validation_step(self, batch: PoseBatch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Collect a validation batch; of several scenes there is a loader each, and all count together."""
        prediction = self(batch.image, batch.intrinsics)
        self.val_errors.update(prediction, batch)
        self.val_loss.update(self.loss(prediction, batch).detach(), len(batch.index))

    def test_step(self, batch: PoseBatch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Collect a test batch."""
        self.test_errors.update(self(batch.image, batch.intrinsics), batch)

    def predict_step(self, batch: PoseBatch, batch_idx: int, dataloader_idx: int = 0) -> PosePrediction:
        """Localize a batch without looking at its true poses."""
        return self(batch.image, batch.intrinsics)

    def on_validation_epoch_end(self) -> None:
        """Log the loss, and the medians and recalls, over the whole validation set."""
        self.log("val/loss", self.val_loss.compute())
        self._log_errors("val", self.val_errors)

    def on_test_epoch_end(self) -> None:
        """Log the medians and recalls over the whole test set."""
        self._log_errors("test", self.test_errors)

    def _log_errors(self, split: str, errors: PoseErrors) -> None:
        for name, value in errors.compute().items():
            self.log(f"{split}/{name}", value, sync_dist=True)

    def on_validation_epoch_start(self) -> None:
        """Forget the previous validation."""
        self.val_loss.reset()
        self.val_errors.reset()

    def on_test_epoch_start(self) -> None:
        """Forget the previous test."""
        self.test_errors.reset()

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Adam and a stepwise learning rate, as the paper prints them, or another schedule.

        Raises:
            InputError: where a schedule over the whole training does not know its length.
        """
        # Lightning refuses to clip a fused optimizer's gradients under mixed precision.
        clips = self._trainer is not None and bool(self.trainer.gradient_clip_val)
        optimizer = build_adam(self, self.lr, self.beta2, self.weight_decay, fused=not clips)
        if self.schedule == "step":
            by_epoch = torch.optim.lr_scheduler.StepLR(optimizer, self.lr_step_epochs, self.lr_gamma)
            return {"optimizer": optimizer, "lr_scheduler": by_epoch}
        by_step = build_step_schedule(optimizer, self.schedule, self.lr, self._steps_in_all())
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": by_step, "interval": "step"}}

    def _steps_in_all(self) -> int:
        batches = max(len(each.train_dataloader()) for each in self.scenes_for("schedule"))
        return training_steps(self.trainer, batches, self.schedule)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Write which system this is and where it was trained."""
        checkpoint["mambaloc"] = {
            "model": self.registry_name,
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "device": provenance.device_name(self.device.index if self.device.type == "cuda" else None),
            "seed": provenance.seed(),
        }
        data = getattr(self._trainer, "datamodule", None)  # saved outside a fit, too
        if describe := getattr(data, "describe", None):
            checkpoint["mambaloc"]["data"] = describe()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Remember where the checkpoint came from.

        Raises:
            InputError: where a training goes on under a schedule that was made for another length.
        """
        self.provenance = checkpoint.get("mambaloc", {})
        if self._trainer is not None and self.trainer.state.fn == "fit" and self.schedule != "step":
            check_span(checkpoint["lr_schedulers"], self._steps_in_all())

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls,
        checkpoint_path: str | Path,
        map_location: str | torch.device | None = None,
        strict: bool | None = None,
        **kwargs: Any,
    ) -> Self:
        """Load a trained system; weights only, never by unpickling code.

        Args:
            checkpoint_path: what a training run wrote.
            map_location: the device to put it on; the CPU unless given.
            strict: whether weights that are missing or left over are an error; they are unless given.
            kwargs: hyperparameters that replace the stored ones.

        Raises:
            InputError: where the file is missing, is not such a checkpoint or holds anything but plain data.
        """
        kwargs.pop("weights_only", None)  # Lightning's option, which might ask for more
        system = build_from(read_checkpoint(checkpoint_path), cls, strict is not False, **kwargs)
        return system.to(map_location or "cpu")
