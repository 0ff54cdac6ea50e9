"""Distillation (MambaLoc, its section III-D): a student learns from true poses and from a trained teacher."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from rich.progress import track
from torch import Tensor, nn

from mambaloc.errors import InputError
from mambaloc.losses import Soft, SoftTargets, cosine_distance
from mambaloc.models import LitPoseRegressor
from mambaloc.models.student import LitStudent, Student
from mambaloc.types import PoseBatch, PosePrediction
from mambaloc.zoo import load

_OWN = ("teacher", "hard_weight", "soft_weight", "feature_weight", "soft", "soft_args", "cache_teacher")
_PREFIX = "distillation."


class TeacherTargets(NamedTuple):
    """What a teacher says of images.

    Shape:
        ``position_m`` (B, 3), ``quaternion`` (B, 4), ``feature`` (B, D): both branches' features side by side.
    """

    position_m: Tensor
    quaternion: Tensor
    feature: Tensor

    @property
    def prediction(self) -> PosePrediction:
        """The pose as a prediction."""
        return PosePrediction(self.position_m, self.quaternion)

    def of(self, index: Tensor) -> TeacherTargets:
        """Those of some rows."""
        return TeacherTargets(*(each[index] for each in self))


class Teacher:
    """A trained system that answers without learning; no module, so that no checkpoint of a student holds it.

    Args:
        system: which.
    """

    def __init__(self, system: LitPoseRegressor) -> None:
        self.system = system.eval().requires_grad_(False)

    @torch.no_grad()
    def __call__(self, image: Tensor) -> TeacherTargets:
        """Localize images, (B, 3, H, W) in 0..1."""
        network = self.system.to(image.device).network
        branches = network.forward_features(image)
        prediction = network.forward_head(branches)
        return TeacherTargets(prediction.position_m, prediction.quaternion, torch.cat(branches, dim=-1))


class DistillationTerms(nn.Module):
    """What only distillation trains: the weights of the soft loss, and a projection of the student's latent feature.

    The projection stands even where the widths agree: the latent feature has been through a ReLU, and a vector without
    negative entries cannot come near the teacher's.

    Args:
        latent: width of the student's feature.
        feature: width of the teacher's.
        soft: ``kl`` or ``l2``.
        soft_args: of :class:`~mambaloc.losses.SoftTargets`.

    Raises:
        InputError: for arguments that the soft loss does not take.
    """

    def __init__(self, latent: int, feature: int, soft: Soft, soft_args: dict[str, Any] | None) -> None:
        super().__init__()
        try:
            self.soft = SoftTargets(soft, **(soft_args or {}))
        except (TypeError, ValueError) as error:
            raise InputError(f"model.soft_args {soft_args}: the soft loss does not take them ({error})") from None
        self.projection = nn.Linear(latent, feature)


class LitDistillation(LitStudent):
    """The student, trained on ``hard + soft + feature``; its checkpoints are a :class:`LitStudent`'s.

    *hard* is the loss against the true poses, as for any system. *soft* compares poses with the teacher's
    (:class:`~mambaloc.losses.SoftTargets`; positions normalised with the scene's, so use ``normalise_position``).
    *feature* is the cosine distance of the latent feature to the teacher's two branch features, side by side. Only
    training frames are distilled on: validation and test see the student alone.

    The other arguments are those of :class:`~mambaloc.models.student.LitStudent`.

    Args:
        teacher: any system, as :func:`mambaloc.load` takes it: a checkpoint or the name of a released model. It
            normalises images and positions in its own way.
        hard_weight: of the loss against true poses; 0 switches it off.
        soft_weight: weight of the soft loss.
        feature_weight: weight of the feature loss.
        soft: ``kl`` as the paper's, or ``l2``.
        soft_args: further arguments of the soft loss: ``temperature``, ``s_position``, ``s_rotation``.
        cache_teacher: ask the teacher once a frame, of its centre crop, before the first epoch.
    """

    registry_name = "student"
    network: Student

    def __init__(
        self,
        teacher: str | None = None,
        hard_weight: float = 1.0,
        soft_weight: float = 1.0,
        feature_weight: float = 1.0,
        soft: Soft = "kl",
        soft_args: dict[str, Any] | None = None,
        cache_teacher: bool = False,
        **student: Any,
    ) -> None:
        if min(hard_weight, soft_weight, feature_weight) < 0 or hard_weight + soft_weight == 0:
            raise InputError(
                f"model: hard_weight {hard_weight}, soft_weight {soft_weight}, feature_weight {feature_weight}: "
                "none may be negative, and one of the first two must be positive to train the heads"
            )
        if teacher is None:
            raise InputError("model.teacher: distillation needs one; train any system, and name its checkpoint")
        if student.get("compile_mode"):
            raise InputError("model.compile_mode: steps with a teacher do not run compiled; set it to null")
        if student.get("feature_cache_gib"):
            raise InputError("model.feature_cache_gib: the teacher needs the images. Set it to 0.")
        super().__init__(**student)
        self.answers: TeacherTargets | None = None

    def setup(self, stage: str) -> None:
        """Meet the teacher before the first epoch; nothing else needs it.

        Raises:
            InputError: where it cannot be loaded or sees images of another size.
        """
        super().setup(stage)
        if stage != "fit":
            return
        path, hparams = self.hparams["teacher"], self.hparams
        system = load(path)
        if system.image_size != self.image_size:
            sizes = " and ".join("x".join(map(str, s.image_size)) for s in (system, self))
            raise InputError(
                f"model.teacher {path}: teacher and student have different image sizes, {sizes} pixels; set "
                "data.image_size"
            )
        self.teacher = Teacher(system)
        width = self.teacher(torch.zeros(1, 3, *self.image_size)).feature.shape[-1]
        self.distillation = DistillationTerms(hparams["width"], width, hparams["soft"], hparams["soft_args"])
        for module, weight in (
            (self.loss, hparams["hard_weight"]),
            (self.distillation.soft, hparams["soft_weight"]),
            (self.distillation.projection, hparams["feature_weight"]),
        ):
            module.requires_grad_(weight > 0)

    def on_fit_start(self) -> None:
        """With ``cache_teacher``, ask it for every training frame."""
        if self.hparams["cache_teacher"]:
            data = self.scene_for("cache_teacher")
            if data.hparams["views"]:
                raise InputError(
                    "model.cache_teacher: works with real frames alone. Turn off cache_teacher or data.views."
                )
            batches = data.batches("train")
            shown = track(batches, "Asking the teacher", transient=True, disable=self.global_rank > 0)
            answers = [self.teacher(batch.image.to(self.device)) for batch in shown]
            self.answers = TeacherTargets(*(torch.cat(each) for each in zip(*answers, strict=True)))

    def training_step(self, batch: PoseBatch, batch_idx: int) -> Tensor:
        """Return the weighed sum of the terms."""
        latent_BD = self.network.latent(batch.image)
        prediction = self.network.forward_head(self.network.branches(latent_BD))
        answer = self.teacher(batch.image) if self.answers is None else self.answers.of(batch.index)
        terms = {
            "hard": lambda: self.loss(prediction, batch),
            "soft": lambda: self.distillation.soft(self._normalized(prediction), self._normalized(answer.prediction)),
            "feature": lambda: cosine_distance(self.distillation.projection(latent_BD), answer.feature),
        }
        loss = torch.zeros((), device=self.device)
        for name, term in terms.items():
            if weight := self.hparams[f"{name}_weight"]:
                value = term()
                loss = loss + weight * value
                self._log_train(name, value, batch)
        self._log_train("loss", loss, batch)
        return loss

    def _normalized(self, prediction: PosePrediction) -> PosePrediction:
        return replace(prediction, position_m=self.network.head.position_scale.normalize(prediction.position_m))

    def _log_train(self, name: str, value: Tensor, batch: PoseBatch) -> None:
        self.log(f"train/{name}", value, on_step=False, on_epoch=True, batch_size=len(batch.index), sync_dist=True)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Write a student's checkpoint, and apart from it what resuming the distillation needs."""
        super().on_save_checkpoint(checkpoint)
        arguments, state = checkpoint["hyper_parameters"], checkpoint["state_dict"]
        checkpoint["mambaloc"]["distilled"] = {name: arguments.pop(name) for name in _OWN}
        if "_class_path" in arguments:  # Lightning's own note of whom a recipe named
            arguments["_class_path"] = f"{LitStudent.__module__}.{LitStudent.__qualname__}"
        checkpoint["mambaloc"]["distilled"]["taught_by"] = self.teacher.system.provenance
        checkpoint["distillation"] = {name: state.pop(name) for name in list(state) if name.startswith(_PREFIX)}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the distillation's own state back before Lightning reads the rest.

        Raises:
            InputError: for a student's checkpoint that no distillation wrote.
        """
        super().on_load_checkpoint(checkpoint)
        if "distillation" not in checkpoint:
            raise InputError(
                "--ckpt_path: is a student's checkpoint, not a distillation's. Give it as model.warm_start."
            )
        checkpoint["state_dict"].update(checkpoint["distillation"])
