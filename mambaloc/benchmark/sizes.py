"""Parameters of every system as the paper counts them: what it publishes beside what is shipped."""

from __future__ import annotations

from dataclasses import dataclass, field

import timm
import torch
from torch import nn

from mambaloc.models import create_model, list_models
from mambaloc.models.student import Student
from mambaloc.models.transposenet import TransPoseNet
from mambaloc.models.weights import parameter_count

PAPER_MIB: dict[tuple[str, str], float] = {
    ("posenet", "none"): 85.26,
    ("posenet", "gis"): 186.12,
    ("lstm_posenet", "none"): 89.6,
    ("lstm_posenet", "gis"): 115.44,
    ("atloc", "none"): 93.3,
    ("atloc", "gis"): 118.69,
    ("transposenet", "none"): 40.57,
    ("transposenet", "gis"): 42.24,
    ("mambaloc", "gis"): 42.24,
    ("student", "none"): 22.69,
}
"""The paper's size table, by system and GIS; it prints MiB as "Mb"."""

UNEXPLAINED = {("lstm_posenet", "none"): "90.01 MiB by its description, and with GIS the paper agrees"}
"""Figures of the paper that no reading of it gives."""

PROGRAMS = {("transposenet", "none"): 10_635_371, ("atloc", "none"): 24_447_558}
"""Parameters counted in the published programs themselves, by system and GIS."""

_PUBLISHED_TABLES = 3 * 60 * 128


@dataclass(frozen=True)
class Size:
    """Parameters of a system.

    Args:
        system: its name.
        gis: its GIS.
        shipped: parameters that it has here.
        replaced: what the published model has besides, or instead, item by item.
    """

    system: str
    gis: str
    shipped: int
    replaced: dict[str, int] = field(default_factory=dict)

    @property
    def published(self) -> int:
        """Parameters of the published model."""
        return self.shipped + sum(self.replaced.values())

    @property
    def program(self) -> int | None:
        """Parameters counted in the published program, where they were."""
        return PROGRAMS.get((self.system, self.gis))

    @property
    def paper_mib(self) -> float | None:
        """What the paper prints, where it does."""
        return PAPER_MIB.get((self.system, self.gis))


def size_table() -> list[Size]:
    """Count every registered system with and without GIS, as its defaults build it."""
    return [size_of(name, gis) for name in list_models() for gis in ("none", "gis")]


def size_of(name: str, gis: str) -> Size:
    """Count a system."""
    with torch.device("meta"):  # counted, never filled
        network = create_model(name, gis=gis).network
    return Size(name, gis, parameter_count(network), published_items(network))


def published_items(network: nn.Module) -> dict[str, int]:
    """What a published model has besides ours, item by item; negative for what it has instead.

    The published TransPoseNet and MambaLoc carry the whole EfficientNet-B0, of which the last stages, last
    convolution and classifier never touch the output, and three position tables of 60 x 128 whatever the image. The
    student carries its backbone's classifier.
    """
    if isinstance(network, Student):
        return {
            "unused classifier": _published_parameter_count(network.backbone.name) - parameter_count(network.backbone)
        }
    if not isinstance(network, TransPoseNet):
        return {}
    encoders = (network.position_encoder, network.orientation_encoder)
    return {
        "never reaches an output": _published_parameter_count(network.backbone.name)
        - parameter_count(network.backbone),
        "our position tables": -sum(parameter_count(encoder.positions) for encoder in encoders),
        "published position tables": _PUBLISHED_TABLES,
    }


def _published_parameter_count(backbone: str) -> int:
    with torch.device("meta"):
        return parameter_count(timm.create_model(backbone))
