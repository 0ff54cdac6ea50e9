"""How a camera differs from the pinhole that its intrinsics claim."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.runtime.maps.features import Features

Floats = NDArray[np.floating[Any]]

_STEPS = 10


@dataclass(frozen=True)
class Lens:
    """``claimed = focal * ideal * (1 + radial * |ideal|^2)``, both (N, 2) in the plane at depth 1.

    ``ideal`` is where a pinhole sees a point, ``claimed`` where the claimed intrinsics say that its pixel looks.

    Args:
        focal: the true focal length over the claimed one.
        radial: the first coefficient of OpenCV's radial distortion.
    """

    focal: float = 1.0
    radial: float = 0.0

    @property
    def numbers(self) -> Floats:
        """Focal and radial, (2,)."""
        return np.array([self.focal, self.radial])

    def distort(self, ideal: Floats) -> Floats:
        """Where the claimed intrinsics say that ideal rays look, (N, 2)."""
        return np.asarray(self.focal * ideal * (1 + self.radial * _square(ideal)))

    def undistort(self, claimed: Floats) -> Floats:
        """The inverse of :meth:`distort`, by fixed-point steps."""
        ideal = straight = claimed / self.focal
        for _ in range(_STEPS):
            ideal = straight / (1 + self.radial * _square(ideal))
        return ideal

    def slopes(self, ideal: Floats) -> tuple[Floats, Floats]:
        """Derivatives of :meth:`distort` by the ray (N, 2, 2), and by focal and radial (N, 2, 2)."""
        square, column = _square(ideal)[..., None], ideal[..., None]
        by_ray = self.focal * ((1 + self.radial * square) * np.eye(2) + 2 * self.radial * column * ideal[:, None])
        return by_ray, np.concatenate(((1 + self.radial * square) * column, self.focal * square * column), axis=-1)

    def straighten(self, features: Features) -> Features:
        """The same keypoints where a pinhole with the claimed intrinsics would see them."""
        intrinsics = features.intrinsics
        pixels = self.undistort(features.rays) @ intrinsics[:2, :2].T + intrinsics[:2, 2]
        return replace(features, pixels=pixels)


def _square(rays: Floats) -> Floats:
    return np.asarray((rays**2).sum(axis=-1, keepdims=True))
