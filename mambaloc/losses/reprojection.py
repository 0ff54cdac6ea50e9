"""Reprojection error of the scene points that a frame sees (Kendall and Cipolla 2017, section 3.4)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mambaloc.errors import InputError
from mambaloc.geometry import project_from_world
from mambaloc.types import PoseBatch, PosePrediction

_NEAR_M = 0.1


class Reprojection(nn.Module):
    """Mean L1 distance, in pixels, of where the true and the predicted camera see each visible point.

    Visible are the points that the true camera sees inside of its image. A point that the predicted camera has
    behind it or nearly so is seen from ``0.1 m``. Each distance is clipped, so that a far-off prediction cannot drown
    the others; where all are clipped there is nothing to learn from, hence the warm start.

    Args:
        clip_px: largest distance of a point.
    """

    def __init__(self, clip_px: float = 100.0) -> None:
        super().__init__()
        if clip_px <= 0:
            raise ValueError(f"clip_px is positive, not {clip_px}")
        self.clip_px = float(clip_px)

    def forward(self, prediction: PosePrediction, target: PoseBatch) -> Tensor:
        """Compare over all frames that see a point; a scalar, 0 where none does.

        Raises:
            InputError: for batches without scene points.
        """
        if target.points_m is None or target.intrinsics is None:
            raise InputError(
                "loss reprojection: needs the scene points that each frame sees; set data.points_per_frame, say to 256"
            )
        is_point = target.points_m.isfinite().all(dim=-1)
        points_m = torch.where(is_point[..., None], target.points_m, 0.0)  # a NaN would reach every gradient
        true_px, is_in_front = project_from_world(
            points_m, target.position_m, target.quaternion, target.intrinsics, _NEAR_M
        )
        height, width = target.image.shape[-2:]
        x_px, y_px = true_px.unbind(dim=-1)  # pixel centres are whole numbers
        in_view = (x_px >= -0.5) & (x_px <= width - 0.5) & (y_px >= -0.5) & (y_px <= height - 0.5)
        visible = is_point & is_in_front & in_view

        predicted_px, _ = project_from_world(
            points_m, prediction.position_m, prediction.quaternion, target.intrinsics, _NEAR_M
        )
        distance_px = (predicted_px - true_px).abs().sum(-1).clamp_max(self.clip_px)
        count = visible.sum(-1)
        per_frame_px = torch.where(visible, distance_px, 0.0).sum(-1) / count.clamp_min(1)
        return per_frame_px.sum() / (count > 0).sum().clamp_min(1)
