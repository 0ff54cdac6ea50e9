"""What turns global features into poses: regression heads and the scene's position scale."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn
from typing_extensions import deprecated

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


def last_layers(head: nn.Module, name: str) -> tuple[str, ...]:
    """Beginnings of the names of the weights of a head's last layers, below a name: those that hold its outputs."""
    named = head.named_children()
    return tuple(f"{name}.{child}.{len(each) - 1}." for child, each in named if isinstance(each, RegressionHead))


class PositionScale(nn.Module):
    """Map a head's output to metres with the scene's mean and scale, which travel with the weights.

    It is the identity until :meth:`fit` has seen the training positions.

    Args:
        scenes: how many scenes the network knows, each with a mean and a scale of its own.

    Shape:
        (B, ..., 3), and with several scenes which one each row is of, (B,) -> (B, ..., 3) in metres.
    """

    mean_m: Tensor
    scale_m: Tensor

    def __init__(self, scenes: int = 1) -> None:
        super().__init__()
        of_each = (scenes,) if scenes > 1 else ()
        self.register_buffer("mean_m", torch.zeros(*of_each, 3))
        self.register_buffer("scale_m", torch.ones(of_each))

    def fit(self, position_m: Tensor, scene: int = 0) -> None:
        """Take the mean and the root-mean-square distance from it over a scene's training positions, (N, 3)."""
        self.mean_m.view(-1, 3)[scene] = position_m.mean(0)
        spread_m = (position_m - position_m.mean(0)).square().sum(-1).mean().sqrt().clamp_min(1e-3)
        self.scale_m.view(-1)[scene] = spread_m

    def normalize(self, position_m: Tensor) -> Tensor:
        """Normalize positions in metres by the mean and scale of the only scene; (..., 3) -> (..., 3)."""
        return (position_m - self.mean_m) / self.scale_m

    @deprecated("PositionScale.normalise is now normalize. The old name is removed in the next release.")
    def normalise(self, position_m: Tensor) -> Tensor:
        """Normalize positions. Deprecated: removed in the next release."""
        return self.normalize(position_m)

    def forward(self, normalized: Tensor, scene: Tensor | None = None) -> Tensor:
        """Undo the normalization; (..., 3) -> (..., 3), metres."""
        mean_m, scale_m = self.mean_m, self.scale_m
        if scene is not None:
            between = (1,) * (normalized.dim() - 2)
            mean_m, scale_m = mean_m[scene].view(-1, *between, 3), scale_m[scene].view(-1, *between, 1)
        return normalized * scale_m + mean_m


class PoseHead(nn.Module):
    """From one global feature a branch to a pose: two regression heads and the scene's position scale.

    Args:
        dim: width of both features.
        rotation: ``quaternion`` (4 outputs) or ``log_quaternion`` (3 outputs, see ``mambaloc.geometry``).
        hidden: hidden width of each head's MLP; None for a linear layer.
        scenes: how many position scales there are.

    Shape:
        (B, dim), (B, dim), and with several scenes which one each row is of, (B,) ->
        :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(self, dim: int, rotation: Rotation = "quaternion", hidden: int | None = None, scenes: int = 1) -> None:
        super().__init__()
        if rotation not in get_args(Rotation):
            raise ValueError(f"rotation is 'quaternion' or 'log_quaternion', not {rotation!r}")
        self.is_log = rotation == "log_quaternion"
        self.position = RegressionHead(dim, hidden, 3)
        self.rotation = RegressionHead(dim, hidden, 3 if self.is_log else 4)
        self.position_scale = PositionScale(scenes)

    def forward(self, position_BD: Tensor, rotation_BD: Tensor, scene: Tensor | None = None) -> PosePrediction:
        """Regress the pose."""
        position_m = self.position_scale(self.position(position_BD), scene)
        rotation = self.rotation(rotation_BD)
        if self.is_log:
            return PosePrediction(position_m, quaternion_from_log(rotation), log_quaternion=rotation)
        return PosePrediction(position_m, rotation)
