"""Whether views are good enough to train on: at poses of real frames, held out, they are compared with those."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mambaloc.synthesis.posed_depth import Floats, PosedDepth
from mambaloc.synthesis.splatting import Splatter

_APART = 0.2  # see PosedDepth.apart: about as far as views lie from the frames
_WINDOW_PX = 9
_NOISE = 2.0  # grey levels, standard deviation
_GREY = (0.299, 0.587, 0.114)
_USUAL_SHARE = 0.75
_LEAST_CORRELATION, _LEAST_GAIN = 0.5, 0.1


@dataclass(frozen=True)
class Quality:
    """Views compared with the real frames at their poses.

    Shape:
        ``real``, ``views`` and ``turned`` (V, 3, h, w) uint8: the frame, its view from frames that lie elsewhere, and
        the nearest of these, turned as the frame is. ``of_views`` and ``of_turned`` (V,): how they correlate with the
        frame, the median over pixels of the correlation of grey within 9x9. ``hole_share`` (V,): of the views.
    """

    real: NDArray[np.uint8]
    views: NDArray[np.uint8]
    turned: NDArray[np.uint8]
    of_views: Floats
    of_turned: Floats
    hole_share: Floats

    @property
    def correlation(self) -> float:
        """Of views with real frames, the median."""
        return float(np.median(self.of_views))

    @property
    def gain(self) -> float:
        """How much better views correlate than frames that are turned without any depth, the median."""
        return float(np.median(self.of_views - self.of_turned))

    @property
    def share(self) -> float:
        """Share of views among the images to train on: three in four, or none where they are not worth it.

        They are where they look like the frames, and clearly more so than a frame that was only turned: wrong depth
        moves surfaces to where they are not.
        """
        is_good = self.correlation >= _LEAST_CORRELATION and self.gain >= _LEAST_GAIN
        return _USUAL_SHARE if is_good else 0.0

    def describe(self) -> str:
        """In one line."""
        verdict = f"share {self.share:g}" if self.share else "not worth training on"
        return (
            f"views correlate {self.correlation:.2f} with real frames, turned frames "
            f"{np.median(self.of_turned):.2f}; {100 * self.hole_share.mean():.0f} % holes; {verdict}"
        )


def held_out_quality(source: PosedDepth, count: int = 40, device: torch.device | str = "cpu") -> Quality:
    """Render some of the frames, evenly spread, from those that lie clearly elsewhere.

    Args:
        source: training frames.
        count: how many at most.
        device: that renders.
    """
    splatter = Splatter(source, device)
    rows = np.unique(np.linspace(0, len(source) - 1, min(count, len(source))).round().astype(int))
    poses, size = source.world_from_cam, (source.depth_m.shape[1], source.depth_m.shape[2])
    allowed = source.apart(poses[rows]) > _APART
    views, turned, of_views, of_turned, holes = [], [], [], [], []
    for row, may in zip(rows, allowed, strict=True):
        view = splatter.render(poses[[row]], source.intrinsics[[row]], size, may[None])
        real = torch.from_numpy(source.images[[row]]).to(splatter.device)
        is_seen = ~view.depth_m[0].isnan()
        nearest = int(splatter.nearest(poses[[row]], may[None])[0, 0])
        picture, is_inside = _turned(source, nearest, row)
        other = torch.from_numpy(picture).to(splatter.device)[None]
        is_seen &= torch.from_numpy(is_inside).to(splatter.device)
        views.append(view.images[0].cpu().numpy())
        turned.append(picture)
        of_views.append(float(_correlation(real, view.images)[0][is_seen].nanmedian()))
        of_turned.append(float(_correlation(real, other)[0][is_seen].nanmedian()))
        holes.append(float(view.hole_share[0]))
    return Quality(
        source.images[rows],
        np.stack(views),
        np.stack(turned),
        np.nan_to_num(of_views, nan=0.0),
        np.nan_to_num(of_turned, nan=0.0),
        np.array(holes),
    )


def _turned(source: PosedDepth, row: int, into: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A frame's picture as if its camera were turned as another, and which of its pixels that one sees."""
    turn = source.world_from_cam[into, :3, :3].T @ source.world_from_cam[row, :3, :3]
    homography = source.intrinsics[into] @ turn @ np.linalg.inv(source.intrinsics[row])
    picture = np.ascontiguousarray(source.images[row].transpose(1, 2, 0))
    size = picture.shape[1::-1]
    seen = cv2.warpPerspective(picture, homography, size)
    is_inside = cv2.warpPerspective(np.ones(picture.shape[:2], np.uint8), homography, size)
    return seen.transpose(2, 0, 1).astype(np.uint8), is_inside > 0


def _correlation(first: Tensor, second: Tensor) -> Tensor:
    """Correlation of grey around each pixel, (V, 3, H, W) uint8 twice -> (V, H, W)."""
    weights = torch.tensor(_GREY, device=first.device)[:, None, None]
    a, b = ((image.float() * weights).sum(dim=1, keepdim=True) for image in (first, second))

    def mean(values: Tensor) -> Tensor:
        return F.avg_pool2d(values, _WINDOW_PX, 1, _WINDOW_PX // 2, count_include_pad=False)

    mean_a, mean_b = mean(a), mean(b)
    variances = ((mean(x * x) - m * m).clamp(min=0) + _NOISE**2 for x, m in ((a, mean_a), (b, mean_b)))
    deviation_a, deviation_b = (variance.sqrt() for variance in variances)
    return ((mean(a * b) - mean_a * mean_b) / (deviation_a * deviation_b))[:, 0]
