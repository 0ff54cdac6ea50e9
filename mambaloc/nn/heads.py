"""What turns global features into poses: regression heads and the scene's position scale."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from mambaloc.geometry import quaternion_from_log
from mambaloc.types import PosePrediction

Rotation = Literal["quaternion", "log_quaternion"]
"""What a head regresses for the rotation."""


class RegressionHead(nn.Sequential):
    """A linear layer, or with ``hidden`` an MLP of one hidden layer and GELU.

    Shape:
        (B, dim) -> (B, outputs).
    """

    def __init__(self, dim: int, hidden: int | None, outputs: int) -> None:
        layers = [nn.Linear(dim, hidden), nn.GELU()] if hidden else []
        super().__init__(*layers, nn.Linear(hidden or dim, outputs))

    def forward(self, feats_BD: Tensor) -> Tensor:
        """Regress in float32 even under autocast: bfloat16 would round to 4 mm in a metre."""
        device = feats_BD.device.type
        if not torch.is_autocast_enabled(device):
            return super().forward(feats_BD)
        with torch.autocast(device, enabled=False):
            return super().forward(feats_BD.float())


class PositionScale(nn.Module):
    """Map a head's output to metres with the scene's mean and scale, which travel with the weights.

    It is the identity until :meth:`fit` has seen the training positions.

    Shape:
        (B, 3) -> (B, 3) in metres.
    """

    mean_m: Tensor
    scale_m: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean_m", torch.zeros(3))
        self.register_buffer("scale_m", torch.ones(()))

    def fit(self, position_m: Tensor) -> None:
        """Take the mean and the root-mean-square distance from it over training positions, (N, 3)."""
        self.mean_m.copy_(position_m.mean(0))
        self.scale_m.copy_((position_m - position_m.mean(0)).square().sum(-1).mean().sqrt().clamp_min(1e-3))

    def normalise(self, position_m: Tensor) -> Tensor:
        """Tell positions in metres relative to the scene's mean and scale; (..., 3) -> (..., 3)."""
        return (position_m - self.mean_m) / self.scale_m

    def forward(self, normalised: Tensor) -> Tensor:
        """Undo the normalisation."""
        return normalised * self.scale_m + self.mean_m


class PoseHead(nn.Module):
    """From one global feature a branch to a pose: two regression heads and the scene's position scale.

    Args:
        dim: width of both features.
        rotation: ``quaternion`` (4 outputs) or ``log_quaternion`` (3 outputs, see ``mambaloc.geometry``).
        hidden: hidden width of each head's MLP; None for a linear layer.

    Shape:
        (B, dim), (B, dim) -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(self, dim: int, rotation: Rotation = "quaternion", hidden: int | None = None) -> None:
        super().__init__()
        if rotation not in get_args(Rotation):
            raise ValueError(f"rotation is 'quaternion' or 'log_quaternion', not {rotation!r}")
        self.is_log = rotation == "log_quaternion"
        self.position = RegressionHead(dim, hidden, 3)
        self.rotation = RegressionHead(dim, hidden, 3 if self.is_log else 4)
        self.position_scale = PositionScale()

    def forward(self, position_BD: Tensor, rotation_BD: Tensor) -> PosePrediction:
        """Regress the pose."""
        position_m = self.position_scale(self.position(position_BD))
        rotation = self.rotation(rotation_BD)
        if self.is_log:
            return PosePrediction(position_m, quaternion_from_log(rotation), log_quaternion=rotation)
        return PosePrediction(position_m, rotation)
