"""TransBoNet (Song et al. 2024): ResNet-50 with channel attention, whose last stage is a bottleneck transformer.

No code was published; this is from its description: convolution, self-attention with 2-D relative positions and
channel attention in each block of the last stage, shuffle attention on what they give, one wide layer, two MLPs.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
from timm.layers import SEModule
from timm.layers.bottleneck_attn import BottleneckAttn
from torch import Tensor, nn

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import Backbone, Discretization, GISMode, PoseHead, PoseNetwork, build_gis


class TransformerBottleneck(nn.Module):
    """ResNet bottleneck block with self-attention in place of its 3x3 convolution, then channel attention.

    Args:
        in_channels: depth of the input.
        channels: depth of the output; the bottleneck is a quarter of it.
        grid: rows and columns of the input, which fix the relative position tables.
        heads: attention heads.

    Shape:
        (B, in_channels, rows, columns) -> (B, channels, rows, columns).
    """

    def __init__(self, in_channels: int, channels: int, grid: tuple[int, int], heads: int) -> None:
        super().__init__()
        inner = channels // 4
        self.body = nn.Sequential(
            nn.Conv2d(in_channels, inner, 1, bias=False),
            nn.BatchNorm2d(inner),
            nn.ReLU(),
            BottleneckAttn(inner, feat_size=grid, num_heads=heads),
            nn.BatchNorm2d(inner),
            nn.ReLU(),
            nn.Conv2d(inner, channels, 1, bias=False),
            nn.BatchNorm2d(channels),
            SEModule(channels),
        )
        self.shortcut = (
            nn.Identity()
            if in_channels == channels
            else nn.Sequential(nn.Conv2d(in_channels, channels, 1, bias=False), nn.BatchNorm2d(channels))
        )

    def forward(self, feats_BCHW: Tensor) -> Tensor:
        """Transform, around a residual."""
        return torch.relu(self.body(feats_BCHW) + self.shortcut(feats_BCHW))


class ShuffleAttention(nn.Module):
    """Channel and spatial attention on halves of channel groups, which are then shuffled (Zhang and Yang 2021).

    Args:
        channels: depth; a multiple of ``2 groups``.
        groups: of channels, each halved.

    Shape:
        (B, channels, H, W) -> (B, channels, H, W).
    """

    def __init__(self, channels: int, groups: int) -> None:
        super().__init__()
        half = channels // (2 * groups)
        self.groups = groups
        self.channel_scale, self.spatial_scale = (nn.Parameter(torch.zeros(half, 1, 1)) for _ in range(2))
        self.channel_shift, self.spatial_shift = (nn.Parameter(torch.ones(half, 1, 1)) for _ in range(2))
        self.norm = nn.GroupNorm(half, half, affine=False)  # the scale and the shift follow

    def forward(self, feats_BCHW: Tensor) -> Tensor:
        """Weigh, then let the groups exchange channels."""
        grouped = feats_BCHW.unflatten(1, (self.groups, -1)).flatten(0, 1)
        by_channel, by_place = grouped.chunk(2, dim=1)
        squeezed = by_channel.mean((-2, -1), keepdim=True)
        by_channel = by_channel * torch.sigmoid(self.channel_scale * squeezed + self.channel_shift)
        by_place = by_place * torch.sigmoid(self.spatial_scale * self.norm(by_place) + self.spatial_shift)
        weighed = torch.cat((by_channel, by_place), dim=1).unflatten(0, (-1, self.groups)).flatten(1, 2)
        return weighed.unflatten(1, (2, -1)).transpose(1, 2).flatten(1, 2)


class TransBoNet(PoseNetwork):
    """A backbone to stride 16, three transformer bottlenecks at stride 32, shuffle attention, one wide layer, two MLPs.

    Args:
        backbone: feature maps at stride 16.
        image_size: (height, width) in pixels; fixes the relative position tables.
        stage_channels: depth of the last stage.
        blocks: transformer bottlenecks of it.
        heads: attention heads.
        groups: of shuffle attention.
        width: of the fully connected layer and of GIS.
        head_hidden: hidden width of the pose heads.
        dropout: before the heads.
        gis: ``gis``, ``classical`` or ``none``.
        discretisation: of the state space: ``euler`` or ``zoh``.

    Shape:
        (B, 3, H, W) in 0..1 -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(
        self,
        backbone: Backbone,
        image_size: tuple[int, int] = (224, 224),
        stage_channels: int = 2048,
        blocks: int = 3,
        heads: int = 4,
        groups: int = 64,
        width: int = 2048,
        head_hidden: int = 1024,
        dropout: float = 0.5,
        gis: GISMode = "none",
        discretisation: Discretization = "euler",
    ) -> None:
        super().__init__()
        self.backbone, self.image_size = backbone, image_size
        ((rows, columns),) = backbone.grids(image_size)
        grid = ((rows + 1) // 2, (columns + 1) // 2)
        depths = [*backbone.channels, *[stage_channels] * blocks]
        self.stage = nn.Sequential(
            nn.AvgPool2d(2, ceil_mode=True, count_include_pad=False),
            *(TransformerBottleneck(ins, outs, grid, heads) for ins, outs in pairwise(depths)),
        )
        self.shuffle_attention = ShuffleAttention(stage_channels, groups)
        self.fc = nn.Sequential(nn.Linear(stage_channels, width), nn.ReLU(), nn.Dropout(dropout))
        self.position_gis = build_gis(gis, width, discretisation)
        self.orientation_gis = build_gis(gis, width, discretisation)
        self.head = PoseHead(width, hidden=head_hidden)

    def features(self, feats: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Turn the feature map into both branches' global features; (B, width) each."""
        (stride16_BCHW,) = feats
        feats_BD = self.fc(self.shuffle_attention(self.stage(stride16_BCHW)).mean((-2, -1)))
        return self.position_gis(feats_BD), self.orientation_gis(feats_BD)


@register_model("transbonet")
class LitTransBoNet(LitPoseRegressor):
    """TransBoNet with L1 distances and learned weights.

    The arguments are those of :class:`TransBoNet` and of :class:`~mambaloc.models.base.LitPoseRegressor`.
    """

    def __init__(
        self,
        backbone: str = "seresnet50",
        stage_channels: int = 2048,
        blocks: int = 3,
        heads: int = 4,
        groups: int = 64,
        width: int = 2048,
        head_hidden: int = 1024,
        dropout: float = 0.5,
        loss: str = "learned_weights",
        loss_args: dict[str, Any] | None = None,
        **shared: Any,
    ) -> None:
        if loss == "learned_weights":
            loss_args = {"norm": "l1", "s_position": 0.0, "s_rotation": -3.0, **(loss_args or {})}
        super().__init__(backbone=backbone, loss=loss, loss_args=loss_args, **shared)

    def configure_network(self) -> TransBoNet:
        """Build the network from the hyperparameters."""
        backbone = Backbone(strides=(16,), **self.backbone_arguments)
        return TransBoNet(backbone, self.image_size, **self.hyperparameters_of(TransBoNet))
