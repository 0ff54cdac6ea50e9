"""Position and rotation distances, and the two ways of weighing one against the other."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from mambaloc.geometry import normalize
from mambaloc.types import PoseBatch, PosePrediction

Norm = Literal["l1", "l2"]


def pose_distances(
    prediction: PosePrediction, target: PoseBatch, norm: Norm, nearest_sign: bool
) -> tuple[Tensor, Tensor]:
    """Mean distances of position, in metres, and of unit quaternions, over a batch.

    With ``nearest_sign`` a quaternion is compared with whichever of ``q`` and ``-q`` is nearer: both are the
    same rotation, and targets that cross ``w = 0`` would otherwise jump.

    Shape:
        () and ().
    """
    order = 1 if norm == "l1" else 2
    quaternion = normalize(prediction.quaternion)
    if nearest_sign:
        sign = torch.where((quaternion * target.quaternion).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        quaternion = quaternion * sign
    position_m = torch.linalg.vector_norm(prediction.position_m - target.position_m, ord=order, dim=-1)
    rotation = torch.linalg.vector_norm(quaternion - target.quaternion, ord=order, dim=-1)
    return position_m.mean(), rotation.mean()


def weighed(distance: Tensor, s: Tensor) -> Tensor:
    """Weigh a distance by its learned log-variance (Kendall and Cipolla 2017)."""
    return distance * torch.exp(-s) + s


class LearnedWeights(nn.Module):
    """Learned homoscedastic weights (Kendall and Cipolla 2017; MambaLoc, its equation of the loss).

    ``|x - x^| exp(-s_x) + s_x + |q - q^/|q^|| exp(-s_q) + s_q``. It is unbounded below and may well be
    negative: watch the raw errors beside it.

    Args:
        s_position: initial log-variance of position.
        s_rotation: initial log-variance of rotation.
        norm: ``l2`` (MambaLoc, TransPoseNet) or ``l1``.
        nearest_sign: compare with the nearer of ``q`` and ``-q``.
    """

    def __init__(
        self, s_position: float = -0.5, s_rotation: float = -6.5, norm: Norm = "l2", nearest_sign: bool = False
    ) -> None:
        super().__init__()
        self.s_position = nn.Parameter(torch.tensor(float(s_position)))
        self.s_rotation = nn.Parameter(torch.tensor(float(s_rotation)))
        self.norm, self.nearest_sign = _known(norm), nearest_sign

    def no_weight_decay(self) -> set[str]:
        """Names of the parameters that an optimiser must not decay."""
        return {"s_position", "s_rotation"}

    def forward(self, prediction: PosePrediction, target: PoseBatch) -> Tensor:
        """Weigh the two mean distances; a scalar."""
        position_m, rotation = pose_distances(prediction, target, self.norm, self.nearest_sign)
        return weighed(position_m, self.s_position) + weighed(rotation, self.s_rotation)


class FixedWeights(nn.Module):
    """A fixed balance ``|x - x^| + beta |q - q^/|q^||`` (PoseNet, Kendall et al. 2015).

    Args:
        beta: what a unit of quaternion distance weighs in metres.
        norm: ``l2`` (PoseNet) or ``l1``.
        nearest_sign: compare with the nearer of ``q`` and ``-q``.
    """

    def __init__(self, beta: float = 250.0, norm: Norm = "l2", nearest_sign: bool = False) -> None:
        super().__init__()
        self.beta, self.norm, self.nearest_sign = float(beta), _known(norm), nearest_sign

    def forward(self, prediction: PosePrediction, target: PoseBatch) -> Tensor:
        """Weigh the two mean distances; a scalar."""
        position_m, rotation = pose_distances(prediction, target, self.norm, self.nearest_sign)
        return position_m + self.beta * rotation


def _known(norm: Norm) -> Norm:
    if norm not in get_args(Norm):  # a recipe's loss_args are not checked before they come here
        raise ValueError(f"norm is 'l1' or 'l2', not {norm!r}")
    return norm
