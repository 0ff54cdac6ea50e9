"""The student of MambaLoc's distillation: EfficientNet-B0 and two linear heads, small enough for a phone."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import Discretization, GISMode, PooledBackbone, PoseHead, PoseNetwork, build_gis


class Student(PoseNetwork):
    """A pooled backbone, one layer, and a linear head each for position and rotation.

    Args:
        backbone: one feature per image.
        width: of the latent feature and of GIS. 512 gives the paper's exact size; its text says 1024.
        dropout: of the backbone's feature.
        gis: ``gis``, ``classical`` or ``none``.
        discretisation: of the state space: ``euler`` or ``zoh``.

    Shape:
        (B, 3, H, W) in 0..1 -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(
        self,
        backbone: PooledBackbone,
        width: int = 512,
        dropout: float = 0.1,
        gis: GISMode = "none",
        discretisation: Discretization = "euler",
    ) -> None:
        super().__init__()
        self.backbone = backbone
        self.fc = nn.Sequential(nn.Dropout(dropout), nn.Linear(backbone.width, width), nn.ReLU())
        self.position_gis = build_gis(gis, width, discretisation)
        self.orientation_gis = build_gis(gis, width, discretisation)
        self.head = PoseHead(width)

    def latent(self, image: Tensor) -> Tensor:
        """Return the feature that distillation compares with the teacher's, (B, width)."""
        return self.fc(self.backbone(image))

    def branches(self, latent_BD: Tensor) -> tuple[Tensor, Tensor]:
        """Turn the latent feature into both branches' features; (B, width) each."""
        return self.position_gis(latent_BD), self.orientation_gis(latent_BD)

    def features(self, feats: Tensor) -> tuple[Tensor, Tensor]:
        """Turn the backbone's feature into both branches' global features; (B, width) each."""
        return self.branches(self.fc(feats))


@register_model("student")
class LitStudent(LitPoseRegressor):
    """The student trained by itself, with learned weights as MambaLoc is.

    The arguments are those of :class:`Student` and of :class:`~mambaloc.models.base.LitPoseRegressor`.
    """

    def __init__(
        self, backbone: str = "efficientnet_b0", width: int = 512, dropout: float = 0.1, **shared: Any
    ) -> None:
        super().__init__(backbone=backbone, **shared)

    def configure_network(self) -> Student:
        """Build the network from the hyperparameters."""
        return Student(PooledBackbone(**self.backbone_arguments), **self.hyperparameters_of(Student))
