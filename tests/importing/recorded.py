"""A known trajectory and its rendered images, which each test writes down in a format of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mambaloc.rendering import default_intrinsics, furnished_room, render, smooth_trajectory

SIZE = (64, 48)
FRAMES = 6
_INSIDE_M = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))


@dataclass(frozen=True)
class Recording:
    """What a camera recorded: images as files' bytes, and where they were taken."""

    world_from_cam: NDArray[np.float64]
    jpegs: list[bytes]

    @property
    def position_m(self) -> NDArray[np.float64]:
        return self.world_from_cam[:, :3, 3]

    @property
    def xyzw(self) -> NDArray[np.float64]:
        return Rotation.from_matrix(self.world_from_cam[:, :3, :3]).as_quat(canonical=True)

    def write(self, folder: Path, names: list[str]) -> list[Path]:
        """Write the images under some names."""
        paths = [folder / name for name in names]
        for path, data in zip(paths, self.jpegs, strict=True):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        return paths


def record() -> Recording:
    """Carry a camera through a room."""
    room = furnished_room(_INSIDE_M, seed=0, px_per_m=30)
    poses = smooth_trajectory(FRAMES, seed=3, inside_m=_INSIDE_M, step_deg=9)
    pictures = [render(room, default_intrinsics(SIZE), pose, SIZE)[0] for pose in poses]
    return Recording(poses, [cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes() for rgb in pictures])
