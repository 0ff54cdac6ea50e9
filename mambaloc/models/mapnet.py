"""MapNet (Brahmbhatt et al. 2018): PoseNet that also learns the relative poses within clips of a video."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import Discretisation, GISMode, PooledBackbone, PoseHead, build_gis
from mambaloc.types import PosePrediction


class MapNet(nn.Module):
    """A pooled backbone, one wide layer, and linear heads for position and log-quaternion; it sees single images.

    Args:
        backbone: one feature per image.
        width: of the fully connected layer and of GIS.
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
        discretisation: Discretisation = "euler",
    ) -> None:
        super().__init__()
        self.backbone = backbone
        self.fc = nn.Sequential(nn.Linear(backbone.width, width), nn.ReLU(), nn.Dropout(dropout))
        self.position_gis = build_gis(gis, width, discretisation)
        self.orientation_gis = build_gis(gis, width, discretisation)
        self.head = PoseHead(width, "log_quaternion")

    def features(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return both branches' global features, what their heads read; (B, width) each."""
        feats_BD = self.fc(self.backbone(image))
        return self.position_gis(feats_BD), self.orientation_gis(feats_BD)

    def forward(self, image: Tensor) -> PosePrediction:
        """Localise images."""
        return self.head(*self.features(image))


@register_model("mapnet")
class LitMapNet(LitPoseRegressor):
    """MapNet; it trains on clips, so recipes set ``data.clip_length`` (3) and ``data.clip_skip`` (10).

    The arguments are those of :class:`MapNet` and of :class:`~mambaloc.models.base.LitPoseRegressor`.
    """

    def __init__(
        self, width: int = 2048, dropout: float = 0.5, loss: str = "relative_log_quaternion", **shared: Any
    ) -> None:
        super().__init__(loss=loss, **shared)

    def configure_network(self) -> MapNet:
        """Build the network from the hyperparameters."""
        return MapNet(PooledBackbone(**self.backbone_arguments), **self.hyperparameters_of(MapNet))
