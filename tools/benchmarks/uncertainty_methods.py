"""How well a system knows its own errors, by several estimates: :mod:`mambaloc.uncertainty` was chosen by it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.console import Console
from torch import Tensor, nn
from torchmetrics.functional import spearman_corrcoef
from torchmetrics.functional.classification import binary_auroc

from mambaloc.data import PoseDataModule
from mambaloc.data.augmentation import center_crop
from mambaloc.errors import InputError
from mambaloc.geometry import canonical, cropped_intrinsics, position_error_m, rotate, rotation_error_deg
from mambaloc.images import IMAGE_SUFFIXES, list_images, read_image
from mambaloc.models import LitPoseRegressor
from mambaloc.nn import PoseNetwork
from mambaloc.types import PosePrediction
from mambaloc.uncertainty import (
    ErrorsByDistance,
    UncertaintyHead,
    errors_by_distance,
    head_and_held_out,
    pooled,
)

LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9)
PASSES = 8
"""Draws of dropout."""
REJECTED = 0.2
"""Share of the frames, the least sure ones, that are left out."""

_PLACES = ((0.5, 0.5), (0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0))  # of crops: the middle and the corners

_ByLevel = dict[float, tuple[float, float]]
"""Of position and rotation, by share asked."""

Frames = tuple[Tensor, Tensor | None]
"""Decoded frames, (B, 3, H, W) ``uint8``, larger than the network's crop, and their intrinsics, (B, 3, 3), if known."""

FrameSource = Callable[[], Iterator[Frames]]


@dataclass(frozen=True)
class UncertaintyMethod:
    """An estimate of a pose's uncertainty: larger scores for what should be wrong by more.

    Shape:
        ``position`` and ``rotation`` (N,) over the test frames, ``elsewhere`` (M,) over images of another place, none
        where none were given.

    Args:
        passes: of the network, an image.
    """

    name: str
    passes: int
    position: Tensor
    rotation: Tensor
    elsewhere: Tensor


@dataclass(frozen=True)
class UncertaintyReport:
    """What was found of one system.

    Args:
        name: of the system whose errors are reported.
        where: which system, on which scene.
        held_out_frames: that its radii were measured on.
        position_error_m: of each test frame, (N,).
        rotation_error_deg: of each test frame, (N,).
        coverage: shares of test frames within both radii, for each of :data:`LEVELS`.
        radii: medians of both radii over the test frames, for each of :data:`LEVELS`.
        unfamiliarity: of the test frames, (N,).
        unfamiliarity_elsewhere: of images of another place, (M,); none where none were given.
        ways: the estimates; the first is the exported one.
    """

    name: str
    where: str
    held_out_frames: int
    position_error_m: Tensor
    rotation_error_deg: Tensor
    coverage: _ByLevel
    radii: _ByLevel
    unfamiliarity: Tensor
    unfamiliarity_elsewhere: Tensor
    ways: list[UncertaintyMethod]


def measure_certainty(
    systems: Mapping[str, tuple[LitPoseRegressor, PoseDataModule]], elsewhere: Path | None = None
) -> list[UncertaintyReport]:
    """Compare estimates of a pose's uncertainty on the test frames of trained systems.

    Args:
        systems: by name, each with the data that it was trained with, all of one scene; several are also taken for an
            ensemble.
        elsewhere: folder of images of another place.

    Raises:
        InputError: for too few frames held out, or images that cannot be read.
    """
    networks = [copy.deepcopy(system.network).cpu().float().eval() for system, _ in systems.values()]
    found = []
    for (name, (system, data)), network in zip(systems.items(), networks, strict=True):
        with Console(stderr=True).status(f"measuring {name}"):
            head, held_out = head_and_held_out(system, data)
            data.setup("test")
            test = errors_by_distance(network, head, data, "test")
            there = _no_frames if elsewhere is None else _frames_of(elsewhere, data)
            coverage, radii = _covered(head, held_out, test)
            far = _distances(network, head, data.crop, there)
            by_spread = _by_spread(network, networks, data.crop, _test_frames(data), there)
        found.append(
            UncertaintyReport(
                name,
                f"{system.registry_name} on {data.hparams['dataset']}/{data.hparams['scene']}, test",
                len(held_out.distance),
                test.position_error_m,
                test.rotation_error_deg,
                coverage,
                radii,
                test.distance / head.familiar,
                far / head.familiar,
                [UncertaintyMethod("training images", 1, test.distance, test.distance, far), *by_spread],
            )
        )
    return found


def _covered(head: UncertaintyHead, held_out: ErrorsByDistance, test: ErrorsByDistance) -> tuple[_ByLevel, _ByLevel]:
    """Shares of test frames within the radii, and the radii's medians; the head is left at the last level."""
    errors_N2 = torch.stack((test.position_error_m, test.rotation_error_deg), dim=-1)
    coverage, medians = {}, {}
    for level in LEVELS:
        head.calibrate(held_out, level)
        radii_N2 = head.radii(test.distance)
        position, rotation = (errors_N2 <= radii_N2).double().mean(dim=0).tolist()
        coverage[level] = (position, rotation)
        metres, degrees = radii_N2.quantile(0.5, dim=0).tolist()
        medians[level] = (metres, degrees)
    return coverage, medians


def rank_correlation(score: Tensor, error: Tensor) -> float:
    """Spearman's: 1 where frames are as wrong, in order, as they are unsure."""
    return spearman_corrcoef(score.double(), error.double()).item()


def change_by_rejection(score: Tensor, error: Tensor, rejected: float = REJECTED) -> float:
    """What leaving out the least sure frames changes the median error by, over it; negative where it helps."""
    return (median_of_surest(score, error, 1 - rejected) / error.double().quantile(0.5) - 1).item()


def median_of_surest(score: Tensor, error: Tensor, share: float) -> Tensor:
    """Median error of the surest frames, so large a share of all."""
    kept = score.argsort(stable=True)[: max(1, round(share * len(error)))]
    return error[kept].double().quantile(0.5)


def ood_auroc(score: Tensor, elsewhere: Tensor) -> float:
    """Area under the ROC curve: the chance that an image of another place scores higher than a test frame."""
    of_elsewhere = torch.cat((torch.zeros(len(score)), torch.ones(len(elsewhere))))
    ranks = (
        torch.cat((score, elsewhere)).unique(return_inverse=True)[1].double()
    )  # what is not a probability would be squashed to one
    return binary_auroc(ranks / ranks.max().clamp_min(1), of_elsewhere.long()).item()


def _by_spread(
    network: PoseNetwork, networks: list[PoseNetwork], size: tuple[int, int], test: FrameSource, there: FrameSource
) -> list[UncertaintyMethod]:
    """Ways that localize an image several times, and take how far apart the poses are."""
    methods: dict[str, tuple[int, Callable[[Frames], list[PosePrediction]]]] = {
        "dropout": (PASSES, lambda frames: _dropped_out(network, frames, size)),
        "shifted crops": (5, lambda frames: [_localized(network, frames, size, place) for place in _PLACES]),
    }
    if len(networks) > 1:
        methods[f"ensemble of {len(networks)}"] = (
            len(networks),
            lambda frames: [_localized(each, frames, size) for each in networks],
        )
    ways = [
        UncertaintyMethod(name, passes, *_spreads(poses, test), _spreads(poses, there)[0])
        for name, (passes, poses) in methods.items()
    ]
    if not network.takes_intrinsics:
        return ways
    position, rotation = _disagreement(network, size, test)
    return [UncertaintyMethod("cells", 1, position, rotation, _disagreement(network, size, there)[0]), *ways]


def _localized(
    network: PoseNetwork, frames: Frames, size: tuple[int, int], place: tuple[float, float] = (0.5, 0.5)
) -> PosePrediction:
    """Localize a crop of each frame; ``place`` is 0 at the top or left and 1 at the bottom or right."""
    image, intrinsics = frames
    corner = [int((side - crop) * at) for side, crop, at in zip(image.shape[-2:], size, place, strict=True)]
    crop = image[..., corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]].float() / 255
    return network(crop, None if intrinsics is None else cropped_intrinsics(intrinsics, *corner))


@torch.inference_mode()
def _disagreement(network: PoseNetwork, size: tuple[int, int], source: FrameSource) -> tuple[Tensor, Tensor]:
    """How far a dense head's cells are from the pose that they are solved for, in metres and degrees; (N,) each."""
    position, rotation = [torch.zeros(0)], [torch.zeros(0)]
    for frames in source():
        prediction = _localized(network, frames, size)
        if (cells := prediction.cells) is None:
            return position[0], rotation[0]
        distance_m = position_error_m(cells.position_m, prediction.position_m[:, None])
        position.append((distance_m * cells.position_weights).sum(dim=1))
        if cells.rays_world is not None:
            turned = rotate(prediction.quaternion[:, None], cells.rays_cam)
            angle_deg = torch.rad2deg(2 * torch.asin((cells.rays_world - turned).norm(dim=-1) / 2))
            rotation.append((angle_deg * cells.rotation_weights).sum(dim=1))
    return torch.cat(position), torch.cat(rotation)


@torch.inference_mode()
def _spreads(poses: Callable[[Frames], list[PosePrediction]], source: FrameSource) -> tuple[Tensor, Tensor]:
    spreads = [pose_spread(poses(frames)) for frames in source()]
    none = torch.zeros(0)
    positions, rotations = zip((none, none), *spreads, strict=True)
    return torch.cat(positions), torch.cat(rotations)


def pose_spread(poses: list[PosePrediction]) -> tuple[Tensor, Tensor]:
    """Root mean square distances of K poses to their mean, in metres and degrees; (B,) each."""
    positions_KB3 = torch.stack([each.position_m for each in poses])
    quaternions_KB4 = torch.stack([canonical(each.quaternion) for each in poses])
    sign_KB1 = torch.where((quaternions_KB4 * quaternions_KB4[:1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    mean_m, mean_q = positions_KB3.mean(0), canonical((sign_KB1 * quaternions_KB4).mean(0))
    distance_m = position_error_m(positions_KB3, mean_m.expand_as(positions_KB3))
    angle_deg = rotation_error_deg(quaternions_KB4, mean_q.expand_as(quaternions_KB4))
    return distance_m.square().mean(0).sqrt(), angle_deg.square().mean(0).sqrt()


def _dropped_out(network: PoseNetwork, frames: Frames, size: tuple[int, int]) -> list[PosePrediction]:
    """Poses with dropout as in training (Gal and Ghahramani 2016), the same draws for every batch."""
    drops = [module for module in network.modules() if isinstance(module, nn.Dropout)]
    try:
        for module in drops:
            module.train()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return [_localized(network, frames, size) for _ in range(PASSES)]
    finally:
        network.eval()


@torch.inference_mode()
def _distances(network: PoseNetwork, head: UncertaintyHead, size: tuple[int, int], source: FrameSource) -> Tensor:
    distances = [head.distance(pooled(network.backbone(center_crop(image, size)))) for image, _ in source()]
    return torch.cat([torch.zeros(0), *distances])


def _no_frames() -> Iterator[Frames]:
    return iter(())


def _test_frames(data: PoseDataModule) -> FrameSource:
    return lambda: ((batch.image, batch.intrinsics) for batch in data.test_dataloader())


def _frames_of(folder: Path, data: PoseDataModule) -> FrameSource:
    """Images of another place, their middle cut to the shape of the scene's frames."""
    paths = list_images(folder)
    if not paths:
        raise InputError(f"--elsewhere {folder}: contains no {', '.join(IMAGE_SUFFIXES)}; give a folder of images")
    height, width = next(_test_frames(data)())[0].shape[-2:]

    def read() -> Iterator[Frames]:
        for path in paths:
            rgb = read_image(path)
            scale = min(rgb.shape[0] / height, rgb.shape[1] / width)
            rows, columns = round(height * scale), round(width * scale)
            top, left = (rgb.shape[0] - rows) // 2, (rgb.shape[1] - columns) // 2
            middle = np.ascontiguousarray(rgb[top : top + rows, left : left + columns])
            shaped = cv2.resize(middle, (width, height), interpolation=cv2.INTER_AREA)
            yield torch.from_numpy(shaped.transpose(2, 0, 1).copy())[None], None

    return read
