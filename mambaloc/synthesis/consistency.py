"""Depth that other frames confirm: carried into them by the poses, it meets the surface that they see."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.synthesis.posed_depth import Floats, PosedDepth
from mambaloc.synthesis.splatting import between, carried

MIN_AGREEMENT = 0.7
"""Share of a frame's depth that others must meet; with sensors and their own poses it is 0.85 and more."""

_OTHERS = 6
_MIN_DISTANCE, _MAX_DISTANCE = 0.05, 1.0  # see PosedDepth.distance; errors of nearer frames are correlated
_CLEAR_DISTANCE = 0.2  # nearer frames agree under a wrong unit, too
_MIN_PIXELS = 0.05  # of a frame that another sees too


def confirmed(source: PosedDepth, by: int = 2, within: float = 0.05) -> PosedDepth:
    """Drop the depth of pixels that fewer than ``by`` of six other frames confirm ``within`` a share of it."""
    depth_m = source.depth_m.copy()
    for row, ratio in enumerate(_ratios(source, _MIN_DISTANCE)):
        depth_m[row, (np.abs(ratio - 1) < within).sum(axis=0) < by] = np.nan
    return replace(source, depth_m=depth_m)


def agreement(source: PosedDepth, within: float = 0.05) -> Floats:
    """Share of each frame's depth that meets what others see, the median over them, (S,); NaN where none sees it.

    Depth of another unit, of another frame, or under a wrong pose has a small share.
    """
    shares = []
    for ratio in _ratios(source, _CLEAR_DISTANCE):
        seen = np.isfinite(ratio)
        is_enough = seen.mean(axis=(1, 2)) > _MIN_PIXELS
        share = (np.abs(ratio - 1) < within)[is_enough].sum(axis=(1, 2)) / seen[is_enough].sum(axis=(1, 2))
        shares.append(np.median(share) if len(share) else np.nan)
    return np.array(shares)


def without_disagreeing(source: PosedDepth, names: Sequence[str]) -> tuple[PosedDepth, dict[str, float]]:
    """Leave out frames whose depth disagrees with the poses.

    Args:
        source: S frames.
        names: of their depth files.

    Returns:
        the frames that are left; and those that are not, by name, with the share of their depth that others meet.

    Raises:
        InputError: where most frames disagree, or see nothing that others see because their depth is less than the
            way from camera to camera: then it is their unit, or the poses.
    """
    shares = agreement(source)
    off = {name: float(share) for name, share in zip(names, shares, strict=True) if share < MIN_AGREEMENT}
    is_lost = np.isnan(shares) & (source.median_depth_m < way_between(source.world_from_cam))
    unmet = np.flatnonzero((shares < MIN_AGREEMENT) | is_lost)
    if len(unmet) > len(source) / 2:
        raise InputError(
            f"{names[unmet[0]]}: depth of this and {len(unmet) - 1} more of {len(source)} frames disagrees with the "
            "poses. Check the unit of both, or do without depth."
        )
    return source.select(~(shares < MIN_AGREEMENT)), off  # NaN stays


def way_between(world_from_cam: Floats) -> float:
    """Distance from a camera to the nearest other, the median over them; 0 where there is one alone."""
    position_m = world_from_cam[:, :3, 3]
    distance_m = np.linalg.norm(position_m[:, None] - position_m, axis=-1)
    np.fill_diagonal(distance_m, np.inf)
    return float(np.median(distance_m.min(axis=1))) if len(position_m) > 1 else 0.0


def _ratios(source: PosedDepth, min_distance: float) -> Iterator[Floats]:
    """For each frame, what others measured over what its depth says that they would, (K, h, w); NaN where nothing."""
    distance = source.distance(source.world_from_cam)
    distance[(distance < min_distance) | (distance > _MAX_DISTANCE)] = np.inf
    for row in range(len(source)):
        others = np.argsort(distance[row], kind="stable")[:_OTHERS]
        yield _ratio(source, row, others[np.isfinite(distance[row, others])])


def _ratio(source: PosedDepth, row: int, others: NDArray[np.int64]) -> Floats:
    height, width = source.depth_m.shape[1:]
    if not len(others):
        return np.full((0, height, width), np.nan)
    from_row = np.full((len(others), 1), row)
    matrix, shift = between(source, from_row, source.world_from_cam[others], source.intrinsics[others])
    depth_m = torch.from_numpy(source.depth_m[row]).reshape(1, 1, 1, -1)
    seen = carried(torch.from_numpy(matrix).float(), torch.from_numpy(shift).float(), (height, width), depth_m)[:, 0]
    x, y, z = (seen[:, 0] / seen[:, 2]).round(), (seen[:, 1] / seen[:, 2]).round(), seen[:, 2]
    is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (z > 0)  # NaN is outside
    pixel = torch.where(is_inside, y * width + x, 0).long()
    measured = torch.from_numpy(source.depth_m[others]).flatten(1).gather(1, pixel)
    ratio = torch.where(is_inside, measured / z, torch.nan)
    return ratio.reshape(len(others), height, width).numpy()
