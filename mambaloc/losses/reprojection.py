"""Reprojection error of the scene points that a frame sees (Kendall and Cipolla 2017, section 3.4)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mambaloc.errors import InputError
from mambaloc.geometry import conjugate, normalize, project, rotate
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
        true_px, is_in_front = _seen_by(target.position_m, target.quaternion, points_m, target.intrinsics)
        height, width = target.image.shape[-2:]
        x_px, y_px = true_px.unbind(dim=-1)  # pixel centres are whole numbers
        in_view = (x_px >= -0.5) & (x_px <= width - 0.5) & (y_px >= -0.5) & (y_px <= height - 0.5)
        visible = is_point & is_in_front & in_view

        predicted_px, _ = _seen_by(prediction.position_m, prediction.quaternion, points_m, target.intrinsics)
        distance_px = (predicted_px - true_px).abs().sum(-1).clamp_max(self.clip_px)
        count = visible.sum(-1)
        per_frame_px = torch.where(visible, distance_px, 0.0).sum(-1) / count.clamp_min(1)
        return per_frame_px.sum() / (count > 0).sum().clamp_min(1)


def _seen_by(position_m: Tensor, quaternion: Tensor, points_m: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (B, P, 2) of world points (B, P, 3), and whether each lies in front of the camera (B, P)."""
    cam_from_world = conjugate(normalize(quaternion))[:, None]
    points_cam_m = rotate(cam_from_world, points_m - position_m[:, None])
    depth_m = points_cam_m[..., 2:]
    at_least_near_m = torch.cat((points_cam_m[..., :2], depth_m.clamp_min(_NEAR_M)), dim=-1)
    return project(at_least_near_m, intrinsics[:, None]), depth_m[..., 0] > _NEAR_M
