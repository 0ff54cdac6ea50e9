"""Multi-Scene TransPoseNet: one network for many scenes, each with a query of its own (Shavit et al. 2021).

Shavit, Ferens and Keller, "Learning Multi-Scene Absolute Pose Regression with Transformers", ICCV 2021.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import Backbone, Discretization, GISMode, PoseHead, PoseNetwork, TokenEncoder, build_gis
from mambaloc.types import PosePrediction


class MultiSceneTransPoseNet(PoseNetwork):
    """TransPoseNet's two encoders, and decoders in which one query a scene asks what the image shows of it.

    A linear layer on what both decoders answer each query says which scene it is; the heads, which all scenes share,
    read the answers of that one.

    Args:
        backbone: feature maps at strides 8 and 16.
        image_size: (height, width) in pixels; fixes the position tables.
        dim: width of encoders, decoders and GIS.
        encoder_layers: layers of each encoder.
        decoder_layers: layers of each decoder.
        heads: attention heads of each layer.
        feedforward: hidden width of each layer's MLP.
        head_hidden: hidden width of the pose heads.
        dropout: residual and MLP dropout; also on the decoders' attention weights.
        gis: ``gis``, ``classical`` or ``none``, on each query's answer.
        discretisation: of the state space: ``euler`` or ``zoh``.
        scenes: how many there are.

    Shape:
        (B, 3, H, W) in 0..1 -> :class:`~mambaloc.types.PosePrediction`, with ``scene_logits`` where there are several.
    """

    scene_tables = ("position_decoder.queries", "orientation_decoder.queries", "head.position_scale.")

    def __init__(
        self,
        backbone: Backbone,
        image_size: tuple[int, int] = (224, 224),
        dim: int = 256,
        encoder_layers: int = 6,
        decoder_layers: int = 6,
        heads: int = 8,
        feedforward: int = 256,
        head_hidden: int = 1024,
        dropout: float = 0.1,
        gis: GISMode = "none",
        discretisation: Discretization = "euler",
        scenes: int = 1,
    ) -> None:
        super().__init__()
        self.backbone, self.image_size, self.scenes = backbone, image_size, scenes
        orientation_grid, position_grid = backbone.grids(image_size)
        orientation_channels, position_channels = backbone.channels
        sizes = (dim, encoder_layers, heads, feedforward, dropout)
        self.position_encoder = TokenEncoder(position_channels, position_grid, *sizes)
        self.orientation_encoder = TokenEncoder(orientation_channels, orientation_grid, *sizes)
        self.position_decoder = SceneDecoder(scenes, dim, decoder_layers, heads, feedforward, dropout)
        self.orientation_decoder = SceneDecoder(scenes, dim, decoder_layers, heads, feedforward, dropout)
        self.position_gis = build_gis(gis, dim, discretisation)
        self.orientation_gis = build_gis(gis, dim, discretisation)
        self.scene_head = nn.Linear(2 * dim, 1) if scenes > 1 else None
        self.head = PoseHead(dim, hidden=head_hidden, scenes=scenes)

    def features(self, feats: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Turn the two feature maps into what both branches answer each scene's query; (B, S, dim) each."""
        stride8_BCHW, stride16_BCHW = feats
        position_BSD = self.position_decoder(self.position_encoder, stride16_BCHW)
        orientation_BSD = self.orientation_decoder(self.orientation_encoder, stride8_BCHW)
        position, orientation = (
            gis(each.flatten(0, 1)).unflatten(0, each.shape[:2])
            for gis, each in ((self.position_gis, position_BSD), (self.orientation_gis, orientation_BSD))
        )
        return position, orientation

    def forward_head(
        self, branches: tuple[Tensor, Tensor], intrinsics: Tensor | None = None, scene: Tensor | None = None
    ) -> PosePrediction:
        """Recognise the scene, and regress the pose from the answers to its query."""
        if self.scene_head is None:
            return self.head(*(each[:, 0] for each in branches))
        logits = self.scene_head(torch.cat(branches, dim=-1)).squeeze(-1)
        scene = logits.argmax(dim=-1) if scene is None else scene
        row = scene.view(-1, 1, 1).expand(-1, 1, branches[0].shape[-1])
        chosen = (each.gather(1, row).squeeze(1) for each in branches)
        return replace(self.head(*chosen, scene), scene_logits=logits)


class SceneDecoder(nn.Module):
    """Transformer decoder of learned queries, one a scene, over the cells of an encoder.

    Args:
        scenes: how many queries.
        dim: token width.
        layers: decoder layers.
        heads: attention heads of each.
        feedforward: hidden width of each layer's MLP.
        dropout: residual, MLP and attention dropout.

    Shape:
        feature map (B, C, H, W) and its encoder -> (B, scenes, dim).
    """

    def __init__(self, scenes: int, dim: int, layers: int, heads: int, feedforward: int, dropout: float) -> None:
        super().__init__()
        self.queries = nn.Parameter(0.02 * torch.randn(scenes, dim))
        layer = nn.TransformerDecoderLayer(
            dim, heads, feedforward, dropout, activation="gelu", batch_first=True, norm_first=True
        )
        self.decoder = nn.TransformerDecoder(layer, layers, nn.LayerNorm(dim))

    def forward(self, encoder: TokenEncoder, feats_BCHW: Tensor) -> Tensor:
        """Ask every scene's query."""
        cells_BND = encoder.cells(feats_BCHW).flatten(2).mT + encoder.positions()[1:]  # the first is the token's
        return self.decoder(self.queries.expand(feats_BCHW.shape[0], -1, -1), cells_BND)


@register_model("multi_scene_transposenet")
class LitMultiSceneTransPoseNet(LitPoseRegressor):
    """Multi-Scene TransPoseNet, trained in a single phase with learned weights.

    The arguments are those of :class:`MultiSceneTransPoseNet` and of
    :class:`~mambaloc.models.base.LitPoseRegressor`.
    """

    takes_scenes: ClassVar[bool] = True

    def __init__(
        self,
        backbone: str = "efficientnet_b0",
        dim: int = 256,
        encoder_layers: int = 6,
        decoder_layers: int = 6,
        heads: int = 8,
        feedforward: int = 256,
        head_hidden: int = 1024,
        dropout: float = 0.1,
        **shared: Any,
    ) -> None:
        super().__init__(backbone=backbone, **shared)

    def configure_network(self) -> MultiSceneTransPoseNet:
        """Build the network from the hyperparameters."""
        backbone = Backbone(strides=(8, 16), **self.backbone_arguments)
        arguments = self.hyperparameters_of(MultiSceneTransPoseNet)
        return MultiSceneTransPoseNet(backbone, self.image_size, scenes=self.scene_count, **arguments)
