"""PoseNet (Kendall et al. 2015), with learned weights and with the reprojection loss (Kendall and Cipolla 2017)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, get_args

from torch import Tensor, nn
from torchvision.models import GoogLeNet, GoogLeNet_Weights

from mambaloc.errors import InputError
from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import (
    Discretization,
    GISMode,
    ImageBackbone,
    PooledBackbone,
    PoseHead,
    PoseNetwork,
    Rotation,
    build_gis,
)
from mambaloc.types import PosePrediction

Variant = Literal["timm", "googlenet"]


class PoseNet(PoseNetwork):
    """A pooled backbone, one wide layer, and a linear head each for position and rotation.

    Args:
        backbone: one feature per image.
        width: of the fully connected layer and of GIS.
        dropout: before the heads.
        rotation: ``quaternion`` or ``log_quaternion``.
        gis: ``gis``, ``classical`` or ``none``.
        discretisation: of the state space: ``euler`` or ``zoh``.

    Shape:
        (B, 3, H, W) in 0..1 -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(
        self,
        backbone: PooledBackbone | GoogLeNetBackbone,
        width: int = 2048,
        dropout: float = 0.5,
        rotation: Rotation = "quaternion",
        gis: GISMode = "none",
        discretisation: Discretization = "euler",
    ) -> None:
        super().__init__()
        self.backbone = backbone
        self.fc = nn.Sequential(nn.Linear(backbone.width, width), nn.ReLU(), nn.Dropout(dropout))
        self.position_gis = build_gis(gis, width, discretisation)
        self.orientation_gis = build_gis(gis, width, discretisation)
        self.head = PoseHead(width, rotation)

    def features(self, feats: Tensor) -> tuple[Tensor, Tensor]:
        """Turn the backbone's feature into both branches' global features; (B, width) each."""
        feats_BD = self.fc(feats)
        return self.position_gis(feats_BD), self.orientation_gis(feats_BD)


class GoogLeNetBackbone(ImageBackbone):
    """GoogLeNet without its classifiers: a pooled feature, and those of its two auxiliary branches.

    Args:
        weights: ``torchvision`` downloads its own; otherwise a ``.safetensors`` file; None starts from scratch.

    Shape:
        (B, 3, H, W) in 0..1 -> (B, 1024).

    Raises:
        InputError: for weights that cannot be fetched, are not there or do not fit.
    """

    width = 1024

    def __init__(self, weights: str | None = None) -> None:
        if weights == "timm":
            raise InputError(
                "backbone_weights timm: GoogLeNet's are torchvision's; give 'torchvision', a file, or null"
            )
        body = GoogLeNet(aux_logits=True, init_weights=False)
        body.fc = body.dropout = body.aux1.fc2 = body.aux2.fc2 = nn.Identity()
        half = (0.5, 0.5, 0.5)  # torchvision's weights expect -1..1
        super().__init__("googlenet", body, None if weights == "torchvision" else weights, half, half)
        if weights == "torchvision":
            try:
                body.load_state_dict(GoogLeNet_Weights.IMAGENET1K_V1.get_state_dict(), strict=False)
            except OSError as error:
                raise InputError(
                    f"model.backbone_weights: torchvision's weights of GoogLeNet could not be fetched "
                    f"({type(error).__name__}). Name a local .safetensors file instead, or null to start from scratch."
                ) from error

    def forward(self, image: Tensor) -> Tensor:
        """Normalise the image and return its feature."""
        return self.with_auxiliary(image)[0] if self.training else self.body(self.normalized(image))

    def with_auxiliary(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """While training: the feature, and those after stages 4d and 4a; (B, 1024) each."""
        return self.body(self.normalized(image))


class GoogLeNetPoseNet(PoseNet):
    """PoseNet as first published: GoogLeNet, whose two auxiliary classifiers regress poses too while it trains.

    The arguments and the shapes are those of :class:`PoseNet`; ``auxiliary`` holds two predictions while training.
    """

    backbone: GoogLeNetBackbone

    def __init__(self, backbone: GoogLeNetBackbone, **kwargs: Any) -> None:
        super().__init__(backbone, **kwargs)
        self.auxiliary_heads = nn.ModuleList(PoseHead(backbone.width) for _ in range(2))

    def forward(self, image: Tensor, intrinsics: Tensor | None = None, scene: Tensor | None = None) -> PosePrediction:
        """Localize images."""
        if not self.training:
            return super().forward(image)
        pooled_BD, *auxiliary = self.backbone.with_auxiliary(image)
        prediction = self.forward_head(self.features(pooled_BD))
        heads = zip(self.auxiliary_heads, auxiliary, strict=True)
        return replace(prediction, auxiliary=tuple(head(feats, feats) for head, feats in heads))


@register_model("posenet")
class LitPoseNet(LitPoseRegressor):
    """PoseNet with a fixed balance of position and rotation: its beta is 120 to 750 indoors, 250 to 2000 outdoors.

    The arguments are those of :class:`PoseNet` and of :class:`~mambaloc.models.base.LitPoseRegressor`, and
    ``variant``: ``timm`` for a timm ``backbone`` (ResNet-34), ``googlenet`` for the first publication's, whose
    ``backbone_weights`` are ``torchvision``, a file or None, and which has no other argument of a backbone.
    """

    def __init__(
        self,
        variant: Variant = "timm",
        width: int = 2048,
        dropout: float = 0.5,
        loss: str = "fixed_weights",
        **shared: Any,
    ) -> None:
        super().__init__(loss=loss, **shared)

    def configure_network(self) -> PoseNet:
        """Build the network from the hyperparameters."""
        variant, options = self.hparams["variant"], self.hyperparameters_of(PoseNet)
        if variant not in get_args(Variant):
            raise InputError(f"model.variant {variant!r}: choose one of {', '.join(get_args(Variant))}")
        if variant == "googlenet":
            return GoogLeNetPoseNet(GoogLeNetBackbone(self.hparams["backbone_weights"]), **options)
        return PoseNet(PooledBackbone(**self.backbone_arguments), **options)


@register_model("posenet_learned")
class LitPoseNetLearned(LitPoseNet):
    """PoseNet with learned homoscedastic weights of L1 distances, from s_x = 0 and s_q = -3.

    The arguments are those of :class:`LitPoseNet`.
    """

    def __init__(self, loss: str = "learned_weights", loss_args: dict[str, Any] | None = None, **shared: Any) -> None:
        if loss == "learned_weights":
            loss_args = {"norm": "l1", "s_position": 0.0, "s_rotation": -3.0, **(loss_args or {})}
        super().__init__(loss=loss, loss_args=loss_args, **shared)


@register_model("posenet_geometric")
class LitPoseNetGeometric(LitPoseNet):
    """PoseNet trained on the reprojection error of visible scene points, from a network trained with learned weights.

    It needs ``data.points_per_frame``, and a ``warm_start``: far from the true pose the clipped error is flat. The
    arguments are those of :class:`LitPoseNet`.
    """

    def __init__(self, loss: str = "reprojection", **shared: Any) -> None:
        super().__init__(loss=loss, **shared)
