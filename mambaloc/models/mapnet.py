"""MapNet (Brahmbhatt et al. 2018): PoseNet that also learns the relative poses within clips of a video."""

from __future__ import annotations

from typing import Any

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.posenet import PoseNet
from mambaloc.models.registry import register_model
from mambaloc.nn import PooledBackbone


@register_model("mapnet")
class LitMapNet(LitPoseRegressor):
    """MapNet: PoseNet's network with a log-quaternion head; it sees single images.

    It trains on clips, so recipes set ``data.clip_length`` (3) and ``data.clip_skip`` (10). The arguments are those of
    :class:`~mambaloc.models.posenet.PoseNet` and of :class:`~mambaloc.models.base.LitPoseRegressor`.
    """

    def __init__(
        self, width: int = 2048, dropout: float = 0.5, loss: str = "relative_log_quaternion", **shared: Any
    ) -> None:
        super().__init__(loss=loss, **shared)

    def configure_network(self) -> PoseNet:
        """Build the network from the hyperparameters."""
        backbone = PooledBackbone(**self.backbone_arguments)
        return PoseNet(backbone, rotation="log_quaternion", **self.hyperparameters_of(PoseNet))
