"""DenseLoc: every cell of the feature map says where it looks, and the pose is solved from all answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, Literal, get_args

import torch
from torch import Tensor, nn

from mambaloc.data.cameras import assumed_intrinsics
from mambaloc.errors import InputError
from mambaloc.geometry import grid_rays
from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import (
    Backbone,
    CellDetail,
    CellHead,
    CellPosition,
    CellRotation,
    Discretization,
    GISMode,
    PoseHead,
    PoseNetwork,
    TokenEncoder,
    build_gis,
    last_layers,
)
from mambaloc.types import PosePrediction

Head = Literal["dense", "token"]


class DenseLoc(PoseNetwork):
    """A transformer over the coarsest feature map, finer maps that add detail to its cells, and a dense head.

    Attention runs over the few coarse cells; the finest map, whose cells answer, costs only products of each cell by
    itself. The camera enters only through the directions of the cells, so that a crop, a turned view or another lens is
    just another pinhole matrix. Rays in place of a quaternion follow Cameras as Rays (Zhang et al. 2024).

    Args:
        backbone: feature maps, the finest first; its cells answer.
        image_size: (height, width) in pixels; fixes the position tables.
        dim: width of the encoder and of GIS.
        encoder_layers: layers of the transformer over the coarsest map.
        heads: attention heads of each layer.
        feedforward: hidden width of each layer's MLP, and of the finest cells'.
        head_hidden: hidden width of the heads; None for linear ones.
        dropout: residual and MLP dropout of the encoder.
        head: ``dense``; or ``token``, the ablation that answers once, from the transformer's token.
        rotation: ``procrustes`` or ``quaternion``, see :class:`~mambaloc.nn.CellHead`.
        position: ``votes`` or ``points``: how the position is solved.
        gis: ``gis``, ``classical`` or ``none``: each cell's, in each branch.
        discretisation: of the state space: ``euler`` or ``zoh``.
        scenes: how many the network knows; the cells' mean says which one an image shows, and each has outputs of its
            own.

    Shape:
        (B, 3, H, W) in 0..1, intrinsics (B, 3, 3) in pixels -> :class:`~mambaloc.types.PosePrediction`.
    """

    default_intrinsics: Tensor
    """(3, 3): those of the training cameras, which are used where none are given."""

    def __init__(
        self,
        backbone: Backbone,
        image_size: tuple[int, int] = (224, 224),
        dim: int = 192,
        encoder_layers: int = 2,
        heads: int = 6,
        feedforward: int = 384,
        head_hidden: int | None = None,
        dropout: float = 0.0,
        head: Head = "dense",
        rotation: CellRotation = "procrustes",
        position: CellPosition = "votes",
        gis: GISMode = "none",
        discretisation: Discretization = "euler",
        scenes: int = 1,
    ) -> None:
        super().__init__()
        self.scenes = scenes
        self.backbone, self.image_size, self.is_dense = backbone, image_size, head == "dense"
        self.takes_intrinsics = self.is_dense  # the token's answer has no camera in it
        grids, (*finer, coarsest) = backbone.grids(image_size), backbone.channels
        self.grid = grids[0]
        self.encoder = TokenEncoder(coarsest, grids[-1], dim, encoder_layers, heads, feedforward, dropout)
        self.detail = CellDetail(sum(finer), self.grid, dim, feedforward) if finer and self.is_dense else None
        self.position_gis = build_gis(gis, dim, discretisation)
        self.orientation_gis = build_gis(gis, dim, discretisation)
        self.head = CellHead(dim, rotation, position, head_hidden, scenes) if self.is_dense else PoseHead(dim)
        self.scene_head = nn.Linear(dim, scenes) if scenes > 1 else None
        self.scene_tables = (*last_layers(self.head, "head"), "head.position_scale.", "scene_head.")
        usual = torch.from_numpy(assumed_intrinsics(image_size[::-1])).float()  # until a training's cameras are known
        self.register_buffer("default_intrinsics", usual)

    def features(self, feats: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Turn the feature maps into both branches' features of each cell; (B, N, dim) each, N = 1 for a token."""
        if not self.is_dense:
            token_BD = self.encoder(feats[-1])
            return self.position_gis(token_BD), self.orientation_gis(token_BD)
        cells_BDHW = self.encoder.cells(feats[-1])
        if self.detail is not None:
            cells_BDHW = self.detail(cells_BDHW, feats[:-1])
        cells_BND = cells_BDHW.flatten(2).mT
        cells_MD = cells_BND.flatten(0, 1)
        position, orientation = (
            gis(cells_MD).unflatten(0, cells_BND.shape[:2]) for gis in (self.position_gis, self.orientation_gis)
        )
        return position, orientation

    def forward_head(
        self, branches: tuple[Tensor, Tensor], intrinsics: Tensor | None = None, scene: Tensor | None = None
    ) -> PosePrediction:
        """Solve the pose of each image's cells."""
        if not isinstance(self.head, CellHead):
            return self.head(*branches)
        if intrinsics is None:
            intrinsics = self.default_intrinsics.expand(branches[0].shape[0], -1, -1)
        assert self.image_size is not None
        rays = grid_rays(intrinsics.float(), self.image_size, self.grid)
        if self.scene_head is None:
            return self.head(*branches, rays, self.grid)
        logits = self.scene_head(branches[0].mean(dim=1))
        prediction = self.head(*branches, rays, self.grid, logits.argmax(dim=-1) if scene is None else scene)
        return replace(prediction, scene_logits=logits)


@register_model("denseloc")
class LitDenseLoc(LitPoseRegressor):
    """DenseLoc, trained on the error of the solved pose and of each cell, with learned weights.

    The arguments are those of :class:`DenseLoc` and of :class:`~mambaloc.models.base.LitPoseRegressor`, and
    ``strides``: those of the feature maps. The cells are those of the first, the transformer sees the last.
    """

    network: DenseLoc
    takes_scenes: ClassVar[bool] = True

    def __init__(
        self,
        backbone: str = "mobilenetv2_100",
        strides: tuple[int, ...] = (8, 16),
        dim: int = 192,
        encoder_layers: int = 2,
        heads: int = 6,
        feedforward: int = 384,
        head_hidden: int | None = None,
        dropout: float = 0.0,
        head: Head = "dense",
        rotation: CellRotation = "procrustes",
        position: CellPosition = "votes",
        loss: str = "cells",
        **shared: Any,
    ) -> None:
        if head not in get_args(Head):
            raise InputError(f"model.head {head!r}: choose one of {', '.join(get_args(Head))}")
        if head == "token" and loss == "cells":
            loss = "learned_weights"
        if head == "token" and len(shared.get("scenes") or ()) > 1:
            raise InputError("model.head 'token': learns one scene. For data.scenes choose dense.")
        super().__init__(backbone=backbone, loss=loss, **shared)

    def configure_network(self) -> DenseLoc:
        """Build the network from the hyperparameters."""
        backbone = Backbone(strides=tuple(self.hparams["strides"]), **self.backbone_arguments)
        return DenseLoc(backbone, self.image_size, scenes=self.scene_count, **self.hyperparameters_of(DenseLoc))

    def setup(self, stage: str) -> None:
        """Take the training cameras' median besides: what an image without intrinsics is taken to be seen by."""
        super().setup(stage)
        if stage == "fit" and getattr(self.trainer, "datamodule", None) is not None:
            intrinsics = torch.cat([each.train_intrinsics for each in self.scenes_for("default_intrinsics")])
            self.network.default_intrinsics.copy_(intrinsics.median(dim=0).values)
