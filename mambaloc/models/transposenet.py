"""TransPoseNet (Shavit et al. 2024): a shared backbone, and per branch a transformer encoder and an MLP head."""

from __future__ import annotations

from typing import Any, ClassVar

from torch import Tensor

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import Backbone, Discretization, GISMode, PoseHead, PoseNetwork, TokenEncoder, build_gis


class TransPoseNet(PoseNetwork):
    """Position is read at stride 16, orientation at stride 8, each by a transformer that attends within its map.

    Args:
        backbone: feature maps at strides 8 and 16.
        image_size: (height, width) in pixels; fixes the position tables.
        dim: width of the encoders and of GIS.
        encoder_layers: layers of each encoder.
        heads: attention heads of each layer.
        feedforward: hidden width of each layer's MLP.
        head_hidden: hidden width of the pose heads.
        dropout: residual and MLP dropout of the encoders.
        attention_dropout: dropout on attention weights; a training step takes 1.2 times as long.
        gis: ``gis``, ``classical`` or ``none``.
        discretisation: of the state space: ``euler`` or ``zoh``.

    Shape:
        (B, 3, H, W) in 0..1 -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(
        self,
        backbone: Backbone,
        image_size: tuple[int, int] = (224, 224),
        dim: int = 256,
        encoder_layers: int = 6,
        heads: int = 8,
        feedforward: int = 256,
        head_hidden: int = 1024,
        dropout: float = 0.1,
        attention_dropout: float = 0.0,
        gis: GISMode = "none",
        discretisation: Discretization = "euler",
    ) -> None:
        super().__init__()
        self.backbone, self.image_size = backbone, image_size
        (orientation_grid, position_grid) = backbone.grids(image_size)
        (orientation_channels, position_channels) = backbone.channels
        encoder: dict[str, Any] = {
            "dim": dim,
            "layers": encoder_layers,
            "heads": heads,
            "feedforward": feedforward,
            "dropout": dropout,
            "attention_dropout": attention_dropout,
        }
        self.position_encoder = TokenEncoder(position_channels, position_grid, **encoder)
        self.orientation_encoder = TokenEncoder(orientation_channels, orientation_grid, **encoder)
        self.position_gis = build_gis(gis, dim, discretisation)
        self.orientation_gis = build_gis(gis, dim, discretisation)
        self.head = PoseHead(dim, hidden=head_hidden)

    def features(self, feats: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Turn the two feature maps into both branches' global features; (B, dim) each."""
        stride8_BCHW, stride16_BCHW = feats
        position_BD = self.position_gis(self.position_encoder(stride16_BCHW))
        orientation_BD = self.orientation_gis(self.orientation_encoder(stride8_BCHW))
        return position_BD, orientation_BD


@register_model("transposenet")
class LitTransPoseNet(LitPoseRegressor):
    """TransPoseNet, trained in a single phase with learned weights.

    The arguments are those of :class:`TransPoseNet` and of :class:`~mambaloc.models.base.LitPoseRegressor`.
    """

    network_class: ClassVar[type[TransPoseNet]] = TransPoseNet

    def __init__(
        self,
        backbone: str = "efficientnet_b0",
        dim: int = 256,
        encoder_layers: int = 6,
        heads: int = 8,
        feedforward: int = 256,
        head_hidden: int = 1024,
        dropout: float = 0.1,
        attention_dropout: float = 0.0,
        **shared: Any,
    ) -> None:
        super().__init__(backbone=backbone, **shared)

    def configure_network(self) -> TransPoseNet:
        """Build the network from the hyperparameters."""
        backbone = Backbone(strides=(8, 16), **self.backbone_arguments)
        return self.network_class(backbone, self.image_size, **self.hyperparameters_of(TransPoseNet))
