"""What every system shares: training, validation, testing, optimiser, checkpoints."""

from __future__ import annotations

import inspect
import math
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, get_args

import lightning as L
import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torch.optim import lr_scheduler

from mambaloc import provenance
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.losses import build_loss
from mambaloc.memory import keep_freed_memory
from mambaloc.metrics import PoseErrors
from mambaloc.nn import Discretisation, GISMode, PoseNetwork, PositionScale
from mambaloc.types import PoseBatch, PosePrediction, height_and_width

Schedule = Literal["step", "cosine", "one_cycle"]
CompileMode = Literal["default", "reduce-overhead"]


class LitPoseRegressor(L.LightningModule):
    """Base of every system: a network that maps images to poses, and how it is trained.

    A subclass builds its network in :meth:`configure_network` and registers itself with
    :func:`~mambaloc.models.registry.register_model`. Every hyperparameter is plain (str, number, bool, None, list,
    dict), so that a checkpoint loads without unpickling code.

    Args:
        image_size: side of the square crop, or (height, width), in pixels; recipes set it once, in ``data``.
        backbone: a timm model.
        backbone_weights: ``timm`` downloads timm's own; otherwise a ``.safetensors`` file; None starts from scratch.
        backbone_args: passed on to timm, for instance ``{"pad_type": "same"}``.
        pixel_mean: RGB mean that the backbone expects, in 0..1; timm's for it unless given.
        pixel_std: RGB deviation, likewise.
        gis: the Global Information Selector of each branch: ``gis``, its ablation ``classical``, or ``none``.
        discretisation: of GIS's state space: ``euler`` or ``zoh``.
        warm_start: checkpoint of a like network, whose weights the training starts from.
        loss: name in ``mambaloc.losses.LOSSES``.
        loss_args: that loss's arguments.
        compile_mode: run training steps through ``torch.compile`` in this mode: ``default``, or ``reduce-overhead``,
            which replays CUDA graphs. It takes a minute or so before the first step, and before the first of another
            size, as an epoch's last may be; less where it was done before.
        frozen_groups: layer groups of the backbone, from the image on, that stay as they start, statistics included.
        frozen_statistics: normalise by the statistics that the backbone starts with, in all of it: for one trained on
            many more images than the scene has.
        lr: learning rate of Adam, or its highest value.
        weight_decay: L2 penalty, never on loss weights nor on a state-space mixer's A and D.
        schedule: ``step`` cuts the learning rate; ``cosine`` lets it fall to nothing over the whole training;
            ``one_cycle`` first lets it rise (Smith and Topin 2018). The last two need the training's length.
        lr_step_epochs: under ``step``, epochs between cuts: 100 indoors, 200 outdoors in the paper.
        lr_gamma: what a cut multiplies the learning rate by.
        normalise_position: regress positions relative to the training positions' mean and spread.
    """

    registry_name: ClassVar[str]
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
        discretisation: Discretisation = "euler",
        warm_start: str | None = None,
        loss: str = "learned_weights",
        loss_args: dict[str, Any] | None = None,
        compile_mode: CompileMode | None = None,
        frozen_groups: int = 0,
        frozen_statistics: bool = False,
        lr: float = 1e-4,
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
        if schedule not in get_args(Schedule):
            raise InputError(f"model.schedule {schedule!r}: choose one of {', '.join(get_args(Schedule))}")
        if compile_mode not in (None, *get_args(CompileMode)):
            raise InputError(f"model.compile_mode {compile_mode!r}: choose one of {', '.join(get_args(CompileMode))}")
        self.schedule, self.normalise_position, self.compile_mode = schedule, normalise_position, compile_mode
        self._compiled: Callable[[Tensor], PosePrediction] | None = None
        self.val_errors, self.test_errors = PoseErrors(), PoseErrors()
        self.provenance: dict[str, Any] = {}
        self.save_hyperparameters()
        self.network = self.configure_network()
        if warm_start is not None:
            start_from(self.network, warm_start)
        if frozen_groups:
            self.network.backbone.freeze(frozen_groups)
        if frozen_statistics:
            self.network.backbone.freeze_statistics()

    def configure_network(self) -> PoseNetwork:
        """Build the network from the hyperparameters: images in, :class:`~mambaloc.types.PosePrediction` out."""
        raise TypeError(f"{type(self).__name__} defines no configure_network()")

    @property
    def backbone_arguments(self) -> dict[str, Any]:
        """What the hyperparameters say of the backbone, as ``mambaloc.nn``'s backbones take it."""
        names = ("backbone", "backbone_weights", "backbone_args", "pixel_mean", "pixel_std")
        taken_as = ("name", "weights", "timm_args", "pixel_mean", "pixel_std")
        return {theirs: self.hparams[ours] for theirs, ours in zip(taken_as, names, strict=True)}

    def hyperparameters_of(self, network: type[nn.Module]) -> dict[str, Any]:
        """Those of this system's hyperparameters that a network class takes, beside its backbone and image size."""
        taken = set(inspect.signature(network).parameters) - {"backbone", "image_size"}
        return {name: value for name, value in self.hparams.items() if name in taken}

    def forward(self, image: Tensor) -> PosePrediction:
        """Localise images, (B, 3, H, W) in 0..1."""
        return self.network(image)

    def setup(self, stage: str) -> None:
        """Take the scene's position statistics, and compile what the epochs run, before the first epoch.

        Raises:
            InputError: where nothing can compile it.
        """
        if stage == "fit":
            keep_freed_memory()
        if stage == "fit" and self.normalise_position:
            for module in self.network.modules():
                if isinstance(module, PositionScale):
                    module.fit(self.scene_for("normalise_position").train_position_m)
        if stage == "fit" and self.compile_mode is not None:
            if "CXX" not in os.environ and not any(map(shutil.which, ("c++", "g++", "clang++", "cl"))):
                raise InputError("model.compile_mode: needs a C++ compiler; install g++, or set it to null")
            if self.trainer.accumulate_grad_batches > 1 and self.compile_mode == "reduce-overhead":
                raise InputError(
                    "model.compile_mode reduce-overhead: a replayed graph overwrites gradients that are to be summed; "
                    "set it to default, or trainer.accumulate_grad_batches to 1"
                )
            # The function, not the module: the state dict keeps its names, and validation, whose predictions outlive
            # the step that a CUDA graph overwrites, runs without.
            self._compiled = torch.compile(self.network.forward, mode=self.compile_mode)

    def teardown(self, stage: str) -> None:
        """Let go of what was compiled: checkpoints and copies know nothing of it."""
        self._compiled = None

    def scene_for(self, argument: str) -> Any:
        """Return the trainer's data module, of which an argument asks more than batches.

        Raises:
            InputError: where the trainer was given loaders alone.
        """
        data = getattr(self.trainer, "datamodule", None)
        if data is None:
            raise InputError(f"model.{argument}: needs the scene; give the trainer a PoseDataModule")
        return data

    def on_train_epoch_start(self) -> None:
        """Log the learning rate."""
        self.log("train/lr", self.optimizers().param_groups[0]["lr"], sync_dist=True)  # type: ignore[union-attr]

    def on_train_batch_start(self, batch: PoseBatch, batch_idx: int) -> None:
        """Tie dropout to (seed, step, rank), so that a resumed run continues exactly."""
        torch.manual_seed(hash((provenance.seed(), self.current_epoch, batch_idx, self.global_rank)))

    def training_step(self, batch: PoseBatch, batch_idx: int) -> Tensor:
        """Return the loss of a batch; auxiliary heads weigh 0.3 each (Szegedy et al. 2015)."""
        prediction = (self._compiled or self)(batch.image)
        loss = self.loss(prediction, batch)
        for auxiliary in prediction.auxiliary:
            loss = loss + 0.3 * self.loss(auxiliary, batch)
        self.log("train/loss", loss, on_step=False, on_epoch=True, batch_size=len(batch.index), sync_dist=True)
        return loss

    def on_train_epoch_end(self) -> None:
        """Log the learned loss weights."""
        for name, parameter in self.loss.named_parameters():
            self.log(f"train/{name}", parameter.detach(), sync_dist=True)

    def validation_step(self, batch: PoseBatch, batch_idx: int) -> None:
        """Collect a validation batch."""
        prediction = self(batch.image)
        self.val_errors.update(prediction, batch)
        self.log("val/loss", self.loss(prediction, batch), batch_size=len(batch.index), sync_dist=True)

    def test_step(self, batch: PoseBatch, batch_idx: int) -> None:
        """Collect a test batch."""
        self.test_errors.update(self(batch.image), batch)

    def predict_step(self, batch: PoseBatch, batch_idx: int) -> PosePrediction:
        """Localise a batch without looking at its true poses."""
        return self(batch.image)

    def on_validation_epoch_end(self) -> None:
        """Log the medians and recalls over the whole validation set."""
        self._log_errors("val", self.val_errors)

    def on_test_epoch_end(self) -> None:
        """Log the medians and recalls over the whole test set."""
        self._log_errors("test", self.test_errors)

    def _log_errors(self, split: str, errors: PoseErrors) -> None:
        for name, value in errors.compute().items():
            self.log(f"{split}/{name}", value, sync_dist=True)

    def on_validation_epoch_start(self) -> None:
        """Forget the previous validation."""
        self.val_errors.reset()

    def on_test_epoch_start(self) -> None:
        """Forget the previous test."""
        self.test_errors.reset()

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Adam and a stepwise learning rate, as the paper prints them, or another schedule.

        Raises:
            InputError: where a schedule over the whole training does not know its length.
        """
        undecayed = {
            id(parameter)
            for module in self.modules()
            if hasattr(module, "no_weight_decay")
            for name, parameter in module.named_parameters()
            if name in module.no_weight_decay()  # type: ignore[operator]  # timm's are dotted, and may name what a model lacks
        }
        trainable = [p for p in self.parameters() if p.requires_grad]
        groups = [
            {"params": [p for p in trainable if id(p) not in undecayed], "weight_decay": self.weight_decay},
            {"params": [p for p in trainable if id(p) in undecayed], "weight_decay": 0.0},
        ]
        groups = [group for group in groups if group["params"]]
        # Fused, a step reads and writes each parameter once, which is a tenth of the time on a CPU; but Lightning
        # refuses to clip a fused optimiser's gradients under mixed precision.
        clips = self._trainer is not None and bool(self.trainer.gradient_clip_val)
        optimizer = torch.optim.Adam(groups, lr=self.lr, betas=(0.9, 0.999), eps=1e-10, fused=not clips)
        if self.schedule == "step":
            by_epoch = lr_scheduler.StepLR(optimizer, self.lr_step_epochs, self.lr_gamma)
            return {"optimizer": optimizer, "lr_scheduler": by_epoch}
        steps = self._steps_in_all()
        by_step: lr_scheduler.LRScheduler
        if self.schedule == "cosine":
            by_step = lr_scheduler.CosineAnnealingLR(optimizer, steps)
        else:
            by_step = lr_scheduler.OneCycleLR(optimizer, self.lr, steps, cycle_momentum=False)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": by_step, "interval": "step"}}

    def _steps_in_all(self) -> int:
        """Steps of the whole training, which a schedule spans.

        Lightning's own estimate starts the loaders, before a resumed run has told them its epoch.
        """
        trainer = self.trainer
        batches, limit = len(self.scene_for("schedule").train_dataloader()), trainer.limit_train_batches
        batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
        ends = [] if trainer.max_steps == -1 else [trainer.max_steps]
        if trainer.max_epochs not in (None, -1):
            ends.append(trainer.max_epochs * math.ceil(batches / trainer.accumulate_grad_batches))
        if not ends:
            raise InputError(f"model.schedule {self.schedule}: needs the training's length; set trainer.max_epochs")
        return min(ends)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Write which system this is and where it was trained."""
        checkpoint["mambaloc"] = {
            "model": self.registry_name,
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "device": provenance.device_name(self.device.index if self.device.type == "cuda" else None),
            "seed": provenance.seed(),
        }
        if isinstance(data := getattr(self._trainer, "datamodule", None), PoseDataModule):  # saved outside a fit, too
            checkpoint["mambaloc"]["data"] = data.describe()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Remember where the checkpoint came from.

        Raises:
            InputError: where a training goes on under a schedule that was made for another length.
        """
        self.provenance = checkpoint.get("mambaloc", {})
        if self._trainer is not None and self.trainer.state.fn == "fit" and self.schedule != "step":
            for state in checkpoint["lr_schedulers"]:
                spans, needed = state.get("total_steps", state.get("T_max")), self._steps_in_all()
                if spans != needed:
                    raise InputError(
                        f"--ckpt_path: its schedule spans {spans} steps, this training {needed}; keep its length, or "
                        "start from its weights with model.warm_start"
                    )

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls, checkpoint_path: str | Path, map_location: Any = None, **kwargs: Any
    ) -> Self:
        """Load a trained system; weights only, never by unpickling code.

        Backbone weights are in the checkpoint, so whatever started the training is not looked for again.

        Raises:
            InputError: where the file is missing, is no such checkpoint or holds anything but plain data.
        """
        checkpoint = read_checkpoint(checkpoint_path)  # refuse with a clear line first
        for start in ("backbone_weights", "warm_start"):
            if start in checkpoint.get("hyper_parameters", {}):  # a system may have no such argument
                kwargs.setdefault(start, None)
        kwargs["weights_only"] = True
        return super().load_from_checkpoint(checkpoint_path, map_location=map_location, **kwargs)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint's plain data onto the CPU.

    Raises:
        InputError: where the file is missing, unreadable, or holds anything but tensors and plain data.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such checkpoint; a training run writes them to RUN/checkpoints/")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        reason = next((line for line in str(error).splitlines() if "GLOBAL" in line), "not plain tensors").strip()
        raise InputError(f"{path}: refused, since loading it could run code ({reason}); use a trusted export") from None
    except Exception as error:  # torch's unpickler fails on broken files with KeyError, IndexError, struct.error, ...
        raise InputError(f"{path}: not a readable checkpoint ({type(error).__name__}); is it complete?") from None
    ours = checkpoint.get("mambaloc") if isinstance(checkpoint, dict) else None
    if not isinstance(ours, dict) or "model" not in ours:
        raise InputError(f"{path}: not a MambaLoc checkpoint; give one that a training run wrote")
    return checkpoint


def start_from(network: nn.Module, path: str | Path) -> None:
    """Copy the weights of a checkpoint's network.

    Raises:
        InputError: where there is no such checkpoint, or its network is another one.
    """
    prefix = "network."
    try:
        state = read_checkpoint(path)["state_dict"]
    except InputError as error:
        raise InputError(f"model.warm_start: {error}; train it first, or set it to null") from None
    try:
        network.load_state_dict({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise InputError(
            f"model.warm_start: {path}: its network is another one ({reason}); "
            "train that with this recipe's model arguments"
        ) from None


def parameter_count(network: nn.Module) -> int:
    """Count the trainable parameters."""
    return sum(p.numel() for p in network.parameters() if p.requires_grad)


def mib(parameters: int) -> float:
    """Size of so many parameters as float32, in MiB: what the paper prints as "Mb"."""
    return parameters * 4 / 2**20
