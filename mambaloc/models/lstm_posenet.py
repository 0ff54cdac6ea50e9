"""LSTM-PN (Walch et al. 2017): PoseNet whose wide feature is read as a matrix by LSTMs along four directions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.registry import register_model
from mambaloc.nn import Discretization, GISMode, PooledBackbone, PoseHead, PoseNetwork, Rotation, build_gis

_ROWS, _COLUMNS = 32, 64


class LSTMPoseNet(PoseNetwork):
    """A 2048-wide feature as a 32 x 64 matrix; four LSTMs read it down, up, right and left, from a zero state.

    Args:
        backbone: one feature per image.
        hidden: state size of each LSTM; the four final states make the global feature, (B, 4 hidden).
        dropout: before the heads.
        rotation: ``log_quaternion`` (3 outputs, as the paper's size table) or ``quaternion`` (4, as first published).
        gis: ``gis``, ``classical`` or ``none``.
        discretisation: of the state space: ``euler`` or ``zoh``.

    Shape:
        (B, 3, H, W) in 0..1 -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(
        self,
        backbone: PooledBackbone,
        hidden: int = 256,
        dropout: float = 0.5,
        rotation: Rotation = "log_quaternion",
        gis: GISMode = "none",
        discretisation: Discretization = "euler",
    ) -> None:
        super().__init__()
        self.backbone = backbone
        self.fc = nn.Sequential(nn.Linear(backbone.width, _ROWS * _COLUMNS), nn.ReLU())
        self.down_and_up = nn.LSTM(_COLUMNS, hidden, batch_first=True, bidirectional=True)
        self.right_and_left = nn.LSTM(_ROWS, hidden, batch_first=True, bidirectional=True)
        self.dropout = nn.Dropout(dropout)
        self.position_gis = build_gis(gis, 4 * hidden, discretisation)
        self.orientation_gis = build_gis(gis, 4 * hidden, discretisation)
        self.head = PoseHead(4 * hidden, rotation)

    def features(self, feats: Tensor) -> tuple[Tensor, Tensor]:
        """Turn the backbone's feature into both branches' global features; (B, 4 hidden) each."""
        matrix_BRC = self.fc(feats).unflatten(-1, (_ROWS, _COLUMNS))
        _, (vertical_2BE, _) = self.down_and_up(matrix_BRC)
        _, (horizontal_2BE, _) = self.right_and_left(matrix_BRC.mT)
        feats_BD = self.dropout(torch.cat((*vertical_2BE, *horizontal_2BE), dim=-1))
        return self.position_gis(feats_BD), self.orientation_gis(feats_BD)


@register_model("lstm_posenet")
class LitLSTMPoseNet(LitPoseRegressor):
    """LSTM-PN with PoseNet's fixed balance of position and rotation.

    The arguments are those of :class:`LSTMPoseNet` and of :class:`~mambaloc.models.base.LitPoseRegressor`.
    """

    def __init__(
        self,
        hidden: int = 256,
        dropout: float = 0.5,
        rotation: Rotation = "log_quaternion",
        loss: str = "fixed_weights",
        **shared: Any,
    ) -> None:
        super().__init__(loss=loss, **shared)

    def configure_network(self) -> LSTMPoseNet:
        """Build the network from the hyperparameters."""
        return LSTMPoseNet(PooledBackbone(**self.backbone_arguments), **self.hyperparameters_of(LSTMPoseNet))
