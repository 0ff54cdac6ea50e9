"""Whether views are good enough to train on: at poses of real frames, held out, they are compared with those."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mambaloc.images import LUMA
from mambaloc.synthesis.posed_depth import Floats, PosedDepth
from mambaloc.synthesis.splatting import Splatter

MIN_CORRELATION = 0.45
"""Views that correlate less are not trained on."""

_MIN_DISTANCE = 0.2  # see PosedDepth.distance: about as far as views lie from the frames
_WINDOW_PX = 9
_NOISE = 2.0  # grey levels, standard deviation
_USUAL_SHARE = 0.75


@dataclass(frozen=True)
class Quality:
    """Views compared with the real frames at their poses.

    Shape:
        ``real`` and ``views`` (V, 3, h, w) uint8: the frames, and their views from frames that lie elsewhere;
        ``correlations`` (V,): of the two, the median over pixels without holes of the correlation of grey within 9x9;
        ``hole_share`` (V,).
    """

    real: NDArray[np.uint8]
    views: NDArray[np.uint8]
    correlations: Floats
    hole_share: Floats

    @property
    def correlation(self) -> float:
        """Of views with real frames, the median."""
        return float(np.median(self.correlations))

    @property
    def share(self) -> float:
        """Share of views among the images to train on: three in four; none where the depth puts surfaces elsewhere."""
        return _USUAL_SHARE if self.correlation >= MIN_CORRELATION else 0.0

    def describe(self) -> str:
        """In one line."""
        verdict = f"{100 * self.share:.0f} % of the images may be views" if self.share else "not worth training on"
        return f"correlation with real frames {self.correlation:.2f}, holes {self.hole_share.mean():.0%}: {verdict}"


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
    allowed = source.distance(poses[rows]) > _MIN_DISTANCE
    views, correlations, holes = [], [], []
    for row, may in zip(rows, allowed, strict=True):
        view = splatter.render(poses[[row]], source.intrinsics[[row]], size, may[None])
        real = torch.from_numpy(source.images[[row]]).to(splatter.device)
        correlation = _correlation(real, view.images)[~view.depth_m.isnan()].nanmedian()
        views.append(view.images[0].cpu().numpy())
        correlations.append(float(correlation.nan_to_num(0)))  # a view may be one hole
        holes.append(float(view.hole_share[0]))
    return Quality(source.images[rows], np.stack(views), np.array(correlations), np.array(holes))


def _correlation(first: Tensor, second: Tensor) -> Tensor:
    """Correlation of grey around each pixel, (V, 3, H, W) uint8 twice -> (V, H, W)."""
    weights = torch.tensor(LUMA, device=first.device)[:, None, None]
    a, b = ((image.float() * weights).sum(dim=1, keepdim=True) for image in (first, second))

    def mean(values: Tensor) -> Tensor:
        return F.avg_pool2d(values, _WINDOW_PX, 1, _WINDOW_PX // 2, count_include_pad=False)

    mean_a, mean_b = mean(a), mean(b)
    variances = ((mean(x * x) - m * m).clamp(min=0) + _NOISE**2 for x, m in ((a, mean_a), (b, mean_b)))
    deviation_a, deviation_b = (variance.sqrt() for variance in variances)
    return ((mean(a * b) - mean_a * mean_b) / (deviation_a * deviation_b))[:, 0]
