"""AtLoc (Wang et al. 2020): PoseNet whose feature attends to itself."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import Discretization, GISMode, PooledBackbone, PoseHead, PoseNetwork, build_gis


class FeatureAttention(nn.Module):
    """Non-local attention among the entries of one vector: ``x + W softmax(phi(x) theta(x)^T) g(x)``.

    Args:
        dim: width of the vector.
        inner: width of the three projections; ``dim / 8`` in AtLoc.

    Shape:
        (B, dim) -> (B, dim).
    """

    def __init__(self, dim: int, inner: int) -> None:
        super().__init__()
        self.g, self.theta, self.phi = (nn.Linear(dim, inner) for _ in range(3))
        self.out = nn.Linear(inner, dim)

    def forward(self, feats_BD: Tensor) -> Tensor:
        """Attend, around a residual."""
        affinity_BEE = self.phi(feats_BD)[:, :, None] * self.theta(feats_BD)[:, None, :]
        attended_BE = (affinity_BEE.softmax(dim=-1) @ self.g(feats_BD)[:, :, None]).squeeze(-1)
        return feats_BD + self.out(attended_BE)


class AtLoc(PoseNetwork):
    """A pooled backbone, one wide layer, attention on it, and linear heads for position and log-quaternion.

    With GIS each half of the attended feature has its own, as the paper's size table says, and both heads read both.

    Args:
        backbone: one feature per image.
        width: of the fully connected layer.
        dropout: before the heads.
        gis: ``gis``, ``classical`` or ``none``.
        discretisation: of the state space: ``euler`` or ``zoh``.

    Shape:
        (B, 3, H, W) in 0..1 -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(
        self,
        backbone: PooledBackbone,
        width: int = 2048,
        dropout: float = 0.5,
        gis: GISMode = "none",
        discretisation: Discretization = "euler",
    ) -> None:
        super().__init__()
        self.backbone = backbone
        self.fc = nn.Sequential(nn.Linear(backbone.width, width), nn.ReLU())
        self.attention = FeatureAttention(width, width // 8)
        self.dropout = nn.Dropout(dropout)
        self.first_gis = build_gis(gis, width // 2, discretisation)
        self.second_gis = build_gis(gis, width // 2, discretisation)
        self.head = PoseHead(width, "log_quaternion")

    def features(self, feats: Tensor) -> tuple[Tensor, Tensor]:
        """Turn the backbone's feature into both branches' global features; (B, width) each, the same one."""
        first_BD, second_BD = self.dropout(self.attention(self.fc(feats))).chunk(2, dim=-1)
        feats_BD = torch.cat((self.first_gis(first_BD), self.second_gis(second_BD)), dim=-1)
        return feats_BD, feats_BD


@register_model("atloc")
class LitAtLoc(LitPoseRegressor):
    """AtLoc on single images; AtLoc+ is its ``loss: relative_log_quaternion`` on clips (``data.clip_length: 3``).

    The arguments are those of :class:`AtLoc` and of :class:`~mambaloc.models.base.LitPoseRegressor`.
    """

    def __init__(self, width: int = 2048, dropout: float = 0.5, loss: str = "log_quaternion", **shared: Any) -> None:
        super().__init__(loss=loss, **shared)

    def configure_network(self) -> AtLoc:
        """Build the network from the hyperparameters."""
        return AtLoc(PooledBackbone(**self.backbone_arguments), **self.hyperparameters_of(AtLoc))
