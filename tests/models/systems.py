"""Every registered system, small and quick, and frames for it to see."""

import inspect
from dataclasses import replace

import lightning as L
import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate

import mambaloc
from mambaloc.benchmark.latency import random_frames
from mambaloc.models import LitPoseRegressor
from mambaloc.models.registry import model_class
from mambaloc.types import PoseBatch, PosePrediction

SIDE = 64  # at stride 32 two by two, among which TransBoNet attends

# What makes a system small; each takes those arguments that it has.
SMALL = {
    "encoder_layers": 1, "decoder_layers": 1, "dim": 32, "heads": 4, "feedforward": 32, "head_hidden": 32, "width": 64,
    "hidden": 16,
    "stage_channels": 64, "blocks": 2, "groups": 4,
}  # fmt: skip

CELLS = [(name, gis) for name in mambaloc.list_models() for gis in ("none", "classical", "gis")]
EVERY = pytest.mark.parametrize(("name", "gis"), CELLS)


def small(name: str, gis: str, seed: int = 0, **kwargs) -> LitPoseRegressor:
    """A system on timm's network for tests; ``kwargs`` are arguments of the system."""
    taken = {
        p
        for c in model_class(name).__mro__
        if issubclass(c, L.LightningModule)
        for p in inspect.signature(c).parameters
    }
    of_it = {k: v for k, v in SMALL.items() if k in taken}
    torch.manual_seed(seed)
    return mambaloc.create_model(
        name, **{"gis": gis, "image_size": SIDE, "backbone": "test_efficientnet", **of_it, **kwargs}
    )


def frames(count: int = 3, seed: int = 0, side: int = SIDE) -> PoseBatch:
    """Smooth images that differ visibly, with poses and points in view."""
    coarse = torch.rand(count, 3, 4, 4, generator=torch.Generator().manual_seed(seed))
    smooth = interpolate(coarse, size=(side, side), mode="bilinear")
    return replace(random_frames(count, side, seed=seed), image=smooth)  # noise in every pixel looks all the same


def flat(prediction: PosePrediction) -> Tensor:
    """Positions and quaternions side by side; (B, 7)."""
    return torch.cat((prediction.position_m, prediction.quaternion), dim=-1)
