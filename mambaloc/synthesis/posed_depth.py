"""Frames with depth, from which views at other poses are rendered."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import deprecated

Floats = NDArray[np.floating[Any]]
Rows = NDArray[np.integer[Any]] | NDArray[np.bool_]


@dataclass(frozen=True)
class PosedDepth:
    """Small images with a depth for each pixel, cameras and poses.

    Shape:
        ``images`` (S, 3, h, w) uint8 RGB; ``depth_m`` (S, h, w) float32 along the optical axis, NaN where unknown;
        ``intrinsics`` (S, 3, 3) in pixels of the images; ``world_from_cam`` (S, 4, 4). Metres stand for the unit of
        the poses, whatever it is.
    """

    images: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    intrinsics: Floats
    world_from_cam: Floats

    def __len__(self) -> int:
        return len(self.images)

    @cached_property
    def median_depth_m(self) -> float:
        """The scene's scale: a camera that moves by a tenth of it sees a tenth of a radian of parallax."""
        known_m = self.depth_m[np.isfinite(self.depth_m)]
        return float(np.median(known_m)) if len(known_m) else np.nan

    def distance(self, world_from_cam: Floats) -> Floats:
        """How differently cameras see: offset in median depths and turn of the view in radians, (V, 4, 4) -> (V, S)."""
        offset = np.linalg.norm(world_from_cam[:, None, :3, 3] - self.world_from_cam[:, :3, 3], axis=-1)
        turn_rad = np.arccos(np.clip(world_from_cam[:, :3, 2] @ self.world_from_cam[:, :3, 2].T, -1, 1))
        return np.hypot(offset / self.median_depth_m, turn_rad)

    @deprecated("PosedDepth.apart is now distance. The old name is removed in the next release.")
    def apart(self, world_from_cam: Floats) -> Floats:
        """Call :meth:`distance` by its old name."""
        return self.distance(world_from_cam)

    def select(self, rows: Rows) -> PosedDepth:
        """Select some rows."""
        return PosedDepth(self.images[rows], self.depth_m[rows], self.intrinsics[rows], self.world_from_cam[rows])

    def digest(self) -> str:
        """Name what these frames are: a hash of all of it."""
        digest = hashlib.sha256()
        for values in (self.images, self.depth_m, self.intrinsics, self.world_from_cam):
            digest.update(f"{values.dtype} {values.shape}".encode())
            digest.update(np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()
