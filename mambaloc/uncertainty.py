"""Conformal error bounds and an out-of-distribution score, from the same forward pass as the pose.

An image is compared with training images in what the backbone sees of it as a whole. The farther the nearest one, the
larger the error: how much larger is measured on frames held out of training, by split conformal prediction (Lei et al.
2018, "Distribution-free predictive inference for regression", section 5.2). That promises its share of frames that come
as the held-out ones did; another walk through the place is another draw. ``tools/benchmarks/uncertainty.py`` measures
this beside dropout, shifted crops and ensembles.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mambaloc.data import MultiSceneDataModule, PoseDataModule
from mambaloc.data.frames import Split
from mambaloc.errors import InputError
from mambaloc.metrics import error_table
from mambaloc.models import LitPoseRegressor
from mambaloc.nn import PoseNetwork
from mambaloc.types import PosePrediction

LEVEL = 0.9
"""Share of poses whose errors are to be within the radii."""

_FAMILIAR = 0.99  # share of held-out frames that count as of the place, once there are enough
_REFERENCES = 256  # training frames that images are compared with
_MIN_SPREAD = 0.1  # of a feature, over the mean of all: one that hardly varied would count for everything
_MIN_INTERCEPT = 0.05  # of a radius' line, over the mean error: a training image's own pose is not exact either


@dataclass(frozen=True)
class ErrorsByDistance:
    """Errors of frames, and how far their images are from the training images.

    Shape:
        (N,) each.
    """

    distance: Tensor
    position_error_m: Tensor
    rotation_error_deg: Tensor


@dataclass(frozen=True)
class Uncertainty:
    """What a model states of its poses of some frames.

    Shape:
        (N,) each: radii in metres and degrees, and the unfamiliarity.
    """

    position_radius_m: Tensor
    rotation_radius_deg: Tensor
    unfamiliarity: Tensor

    def by_frame(self) -> Iterator[tuple[float, float, float]]:
        """The three numbers of each frame."""
        each = (self.position_radius_m, self.rotation_radius_deg, self.unfamiliarity)
        return zip(*(numbers.tolist() for numbers in each), strict=True)


class UncertaintyHead(nn.Module):
    """Radii of a pose, and how far its image is from what the place looks like, from what the backbone returned.

    Args:
        references: what :func:`pooled` gives of training images.

    Shape:
        (B, D) -> three of (B,): the position's radius in metres, the rotation's in degrees, and the unfamiliarity,
        over 1 where the image is farther from the training images than :data:`_FAMILIAR` of the held-out ones.
    """

    references: Tensor
    scale: Tensor
    intercepts: Tensor
    slopes: Tensor
    familiar: Tensor

    def __init__(self, references: Tensor) -> None:
        super().__init__()
        self.level, self.held_out_frames = math.nan, 0
        spread = references.std(dim=0, correction=0)
        scale = 1 / spread.clamp_min(_MIN_SPREAD * spread.mean()).clamp_min(1e-6)
        self.register_buffer("scale", scale)
        self.register_buffer("references", references * scale)
        self.register_buffer("intercepts", torch.full((2,), math.nan))
        self.register_buffer("slopes", torch.zeros(2))
        self.register_buffer("familiar", torch.tensor(math.nan))

    def describe(self) -> dict[str, Any]:
        """Say what the radii promise, and on how many frames they were measured."""
        return {"level": self.level, "held_out_frames": self.held_out_frames}

    def distance(self, pooled_BD: Tensor) -> Tensor:
        """Distance to the nearest training image, (B,), each feature over its spread."""
        difference_BMD = (pooled_BD.float() * self.scale).unsqueeze(1) - self.references
        return difference_BMD.square().sum(dim=-1).amin(dim=1).sqrt()

    def calibrate(self, held_out: ErrorsByDistance, level: float) -> None:
        """Set the radii, a line of the distance each, and how far is unfamiliar.

        Args:
            held_out: frames that nothing was fitted to.
            level: share of such frames that are to be within a radius.

        Raises:
            ValueError: for fewer frames than the level needs, ``level / (1 - level)``.
        """
        far = held_out.distance.double().numpy()
        errors = [each.double().numpy() for each in (held_out.position_error_m, held_out.rotation_error_deg)]
        lines = np.array([_radius_line(far, error, level) for error in errors])
        self.level, self.held_out_frames = level, len(far)
        self.intercepts.copy_(torch.from_numpy(lines[:, 0]))
        self.slopes.copy_(torch.from_numpy(lines[:, 1]))
        familiar = conformal_quantile(far, min(_FAMILIAR, len(far) / (len(far) + 1)))
        self.familiar.fill_(max(familiar, 1e-6))  # held-out frames may all be copies of training frames

    def radii(self, distance: Tensor) -> Tensor:
        """The position's radius in metres and the rotation's in degrees at each distance; (B,) -> (B, 2)."""
        return self.intercepts + self.slopes * distance.unsqueeze(-1)

    def forward(self, pooled_BD: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return both radii and the unfamiliarity."""
        distance = self.distance(pooled_BD)
        radius_B2 = self.radii(distance)
        return radius_B2[:, 0], radius_B2[:, 1], distance / self.familiar


def fit_uncertainty(system: LitPoseRegressor, data: PoseDataModule | MultiSceneDataModule) -> UncertaintyHead:
    """Measure how a system's errors grow with the distance to the training images, on its validation frames.

    Where the best epoch was chosen on them, they flatter it a little. Of several scenes, images are compared with
    those of all: an unfamiliar image shows no known scene.

    Args:
        system: trained; left as it was.
        data: what it was trained with.

    Raises:
        InputError: where too few frames were held out to measure it, or they cannot be read.
    """
    head, held_out = head_and_held_out(system, data)
    head.calibrate(held_out, LEVEL)
    return head


def uncertainty_of_test(system: LitPoseRegressor, data: PoseDataModule) -> Uncertainty | None:
    """What the exported model states of the test frames; None where it states nothing.

    Args:
        system: trained; left as it was.
        data: what it was trained with.
    """
    try:
        head = fit_uncertainty(system, data)
    except InputError:
        return None
    data.setup("test")
    network = copy.deepcopy(system.network).cpu().float().eval()
    with torch.inference_mode():
        return Uncertainty(*head(seen_of(network, (batch.image for batch in data.batches("test")))))


def head_and_held_out(
    system: LitPoseRegressor, data: PoseDataModule | MultiSceneDataModule
) -> tuple[UncertaintyHead, ErrorsByDistance]:
    """Make a head of training images, and measure what it is to be calibrated on.

    The arguments and errors are those of :func:`fit_uncertainty`.
    """
    network = copy.deepcopy(system.network).cpu().float().eval()
    scenes, seen = data.each_scene(), []
    for each, trained_on in zip(scenes, _trained_on(system, len(scenes)), strict=True):
        _check_held_out(each, trained_on)
        rows = each.frames("train").evenly_spread(_REFERENCES)
        seen.append(seen_of(network, (batch.image for batch in each.batches("train", rows))))
    head = UncertaintyHead(torch.cat(seen))
    return head, _together([errors_by_distance(network, head, each, "val") for each in scenes])


def _trained_on(system: LitPoseRegressor, scenes: int) -> list[str | None]:
    """Digests of each scene's training frames, where the system says them."""
    data = system.provenance.get("data", {})
    scenes_data = list(data["scenes"].values()) if "scenes" in data else [data]
    digests = [each.get("fingerprints", {}).get("train") for each in scenes_data]
    return digests if len(digests) == scenes else [None] * scenes


def _together(scenes: list[ErrorsByDistance]) -> ErrorsByDistance:
    """Frames of all scenes whose scene was recognised: of the others the errors are infinite."""
    parts = [(each.distance, each.position_error_m, each.rotation_error_deg) for each in scenes]
    distance, position_m, rotation_deg = (torch.cat(each) for each in zip(*parts, strict=True))
    is_recognized = position_m.isfinite()
    return ErrorsByDistance(*(each[is_recognized] for each in (distance, position_m, rotation_deg)))


def _check_held_out(data: PoseDataModule, trained_on: str | None) -> None:
    validation = data.hparams["validation"]
    if validation in ("none", "test_set"):
        raise InputError(
            f"data.validation {validation}: calibrating the uncertainty needs held-out frames; train with auto"
        )
    if trained_on is not None:  # else nothing need be decoded
        data.setup("fit")
    if trained_on is None or trained_on != data.describe()["fingerprints"]["train"]:
        raise InputError(
            f"{data.folder}: the system was trained on other or unknown frames, so no frame is known "
            "to be held out; give a checkpoint's own"
        )
    count, needed = len(data.frames("val")), math.ceil(LEVEL / (1 - LEVEL) - 1e-9)
    if count < needed:
        raise InputError(
            f"data.validation {validation}: {count} frames are held out, but calibrating the uncertainty "
            f"takes {needed}. Hold out more."
        )


@torch.inference_mode()
def errors_by_distance(
    network: PoseNetwork, head: UncertaintyHead, data: PoseDataModule, part: Split
) -> ErrorsByDistance:
    """Localize the centre crops of a part's frames.

    Args:
        network: in evaluation mode, on the CPU.
        head: made of training images of that network.
        data: set up for the part.
        part: ``val`` or ``test``.
    """
    distances: list[Tensor] = []

    def localize(image: Tensor, intrinsics: Tensor | None) -> PosePrediction:
        feats = network.forward_backbone(image)
        distances.append(head.distance(pooled(feats)))
        return network.forward_head(network.features(feats), intrinsics)

    table = error_table(localize, data.batches(part))
    return ErrorsByDistance(torch.cat(distances), table.position_error_m, table.rotation_error_deg)


@torch.inference_mode()
def seen_of(network: PoseNetwork, images: Iterable[Tensor]) -> Tensor:
    """What a network's backbone sees of images as wholes; batches of (B, 3, H, W) in 0..1 -> (N, D)."""
    return torch.cat([pooled(network.forward_backbone(image)) for image in images])


def pooled(feats: Tensor | list[Tensor]) -> Tensor:
    """What a backbone sees of an image as a whole: its feature, or the means of its maps side by side; (B, D)."""
    return feats if isinstance(feats, Tensor) else torch.cat([each.mean((-2, -1)) for each in feats], dim=-1)


def conformal_quantile(values: NDArray[np.float64], level: float) -> float:
    """The smallest of ``values`` that another value like them exceeds with a chance of at most ``1 - level``.

    Raises:
        ValueError: for too few values for that level.
    """
    rank = math.ceil((len(values) + 1) * level - 1e-9)
    if rank > len(values):
        raise ValueError(f"{len(values)} values are too few for a {level:.0%} quantile")
    return float(np.sort(values)[rank - 1])


def _radius_line(distance: NDArray[np.float64], error: NDArray[np.float64], level: float) -> tuple[float, float]:
    """Intercept and slope: the errors' least-squares line, which never falls, times what lets it hold its share."""
    slope = np.cov(distance, error)[0, 1] / max(distance.var(ddof=1), 1e-12)
    slope = np.clip(slope, 0, (1 - _MIN_INTERCEPT) * error.mean() / max(distance.mean(), 1e-12))
    intercept = error.mean() - slope * distance.mean()
    held = conformal_quantile(error / np.maximum(intercept + slope * distance, 1e-12), level)
    return held * intercept, held * slope
