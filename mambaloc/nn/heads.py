"""What turns a global feature into numbers: regression heads and the scene's position scale."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class RegressionHead(nn.Sequential):
    """MLP with one hidden layer and GELU.

    Shape:
        (B, dim) -> (B, outputs).
    """

    def __init__(self, dim: int, hidden: int, outputs: int) -> None:
        super().__init__(nn.Linear(dim, hidden), nn.GELU(), nn.Linear(hidden, outputs))

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

    def forward(self, normalised: Tensor) -> Tensor:
        """Undo the normalisation."""
        return normalised * self.scale_m + self.mean_m
