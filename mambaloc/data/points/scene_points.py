"""The record that every reader of scene points returns, and the seeded choice among too many points."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Source = Literal["depth", "nvm", "colmap", "tracks", "views"]
Points = NDArray[np.float64]


@dataclass(frozen=True)
class ScenePoints:
    """Scene points that each of N frames may see.

    Shape:
        ``points_m`` (N, P, 3) float32: world frame, NaN where a frame has fewer than P.
    """

    points_m: NDArray[np.float32]
    source: Source

    def per_frame(self) -> NDArray[np.int64]:
        """How many points each frame has, (N,)."""
        return np.isfinite(self.points_m[..., 0]).sum(axis=1)


def frame_rng(seed: int, image: Path) -> np.random.Generator:
    """A generator of a frame's own: its draws do not depend on which other frames are read."""
    return np.random.default_rng((seed, zlib.crc32(f"{image.parent.name}/{image.name}".encode())))


def choose(points_m: Points, count: int, rng: np.random.Generator) -> Points:
    """At most ``count`` of the points, drawn without replacement; (K, 3) -> (min(K, count), 3)."""
    if len(points_m) <= count:
        return points_m
    return points_m[rng.choice(len(points_m), count, replace=False, shuffle=False)]


def stacked(points_m: Sequence[Points], count: int) -> NDArray[np.float32]:
    """Each frame's points, at most ``count``, filled up with NaN: N arrays (K, 3) -> (N, ``count``, 3)."""
    filled = np.full((len(points_m), count, 3), np.nan, dtype=np.float32)
    for row, points in zip(filled, points_m, strict=True):
        row[: len(points)] = points
    return filled
