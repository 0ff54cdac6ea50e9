"""MambaLoc: a shared backbone, and per branch a transformer encoder, a GIS and an MLP head."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import Backbone, Discretisation, GISMode, PositionScale, RegressionHead, TokenEncoder, build_gis
from mambaloc.types import PosePrediction


class MambaLoc(nn.Module):
    """The network of MambaLoc (its section III-B): position is read at stride 16, orientation at stride 8.

    Args:
        image_size: (height, width) in pixels; fixes the position tables.
        backbone: any timm model with feature maps at strides 8 and 16.
        backbone_weights: ``timm``, a ``.safetensors`` file, or None for none.
        backbone_args: passed on to timm, for instance ``{"pad_type": "same"}``.
        pixel_mean: RGB mean that the backbone expects, in 0..1; timm's for it unless given.
        pixel_std: RGB deviation, likewise.
        dim: width of the encoders and of GIS.
        encoder_layers: layers of each encoder.
        heads: attention heads of each layer.
        feedforward: hidden width of each layer's MLP.
        head_hidden: hidden width of the pose heads.
        dropout: residual and MLP dropout of the encoders.
        attention_dropout: dropout on attention weights; it forces the slow attention kernel.
        gis: ``gis``, or the ablations ``classical`` (one Mamba mixer without the flip) and ``none``.
        discretisation: of the state space: ``euler`` or ``zoh``.

    Shape:
        (B, 3, H, W) in 0..1 -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(
        self,
        image_size: tuple[int, int] = (224, 224),
        backbone: str = "efficientnet_b0",
        backbone_weights: str | None = None,
        backbone_args: dict[str, Any] | None = None,
        pixel_mean: tuple[float, float, float] | None = None,
        pixel_std: tuple[float, float, float] | None = None,
        dim: int = 256,
        encoder_layers: int = 6,
        heads: int = 8,
        feedforward: int = 256,
        head_hidden: int = 1024,
        dropout: float = 0.1,
        attention_dropout: float = 0.0,
        gis: GISMode = "gis",
        discretisation: Discretisation = "euler",
    ) -> None:
        super().__init__()
        self.image_size = image_size
        self.backbone = Backbone(backbone, (8, 16), backbone_weights, backbone_args, pixel_mean, pixel_std)
        (orientation_grid, position_grid) = self.backbone.grids(image_size)
        (orientation_channels, position_channels) = self.backbone.channels
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
        self.position_head = RegressionHead(dim, head_hidden, 3)
        self.orientation_head = RegressionHead(dim, head_hidden, 4)
        self.position_scale = PositionScale()

    def forward(self, image: Tensor) -> PosePrediction:
        """Localise images."""
        position_BD, orientation_BD = self.features(image)
        return PosePrediction(
            position_m=self.position_scale(self.position_head(position_BD)),
            quaternion=self.orientation_head(orientation_BD),
        )

    def features(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return both branches' global features, what their heads read; (B, dim) each."""
        if image.shape[-2:] != torch.Size(self.image_size):
            raise ValueError(f"images are {tuple(image.shape[-2:])}, the network was built for {self.image_size}")
        stride8_BCHW, stride16_BCHW = self.backbone(image)
        position_BD = self.position_gis(self.position_encoder(stride16_BCHW))
        orientation_BD = self.orientation_gis(self.orientation_encoder(stride8_BCHW))
        return position_BD, orientation_BD


@register_model("mambaloc")
class LitMambaLoc(LitPoseRegressor):
    """MambaLoc with the paper's training: learned weights from (-0.5, -6.5), Adam, a single phase.

    The arguments are those of :class:`MambaLoc` and of
    :class:`~mambaloc.models.base.LitPoseRegressor`.
    """

    def __init__(
        self,
        backbone: str = "efficientnet_b0",
        backbone_weights: str | None = None,
        backbone_args: dict[str, Any] | None = None,
        pixel_mean: tuple[float, float, float] | None = None,
        pixel_std: tuple[float, float, float] | None = None,
        dim: int = 256,
        encoder_layers: int = 6,
        heads: int = 8,
        feedforward: int = 256,
        head_hidden: int = 1024,
        dropout: float = 0.1,
        attention_dropout: float = 0.0,
        gis: GISMode = "gis",
        discretisation: Discretisation = "euler",
        **training: Any,
    ) -> None:
        super().__init__(**training)

    def configure_network(self) -> MambaLoc:
        """Build the network from the hyperparameters."""
        return MambaLoc(self.image_size, **self.hyperparameters_of(MambaLoc))
