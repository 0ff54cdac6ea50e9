"""A walk whose images can be matched: the axis check of each format that is written down here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mambaloc.importing.capture import Capture
from mambaloc.importing.checks.explanations import AS_READ, by_convention
from mambaloc.importing.checks.matching import find_matches
from mambaloc.importing.motion import motion_of
from mambaloc.rendering import default_intrinsics, furnished_room, render, smooth_trajectory

_INSIDE_M = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))


@dataclass(frozen=True)
class Walk:
    """Images of a pinhole of known poses; pixels count from the centre of the top-left one."""

    world_from_cam: NDArray[np.float64]
    pngs: list[bytes]
    intrinsics: NDArray[np.float64]
    size: tuple[int, int] = (320, 240)

    def write(self, folder: Path, names: list[str]) -> None:
        for name, data in zip(names, self.pngs, strict=True):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)

    def is_agreed(self, capture: Capture) -> None:
        """Check poses, and that images agree with them and the camera as they were read, and no other way."""
        np.testing.assert_allclose(capture.world_from_cam, self.world_from_cam, atol=1e-6)
        shares = by_convention(find_matches(capture, motion_of(capture)), capture.world_from_cam)
        as_read = shares.pop(AS_READ)
        assert as_read > 0.8 > 0.5 > max(shares.values()), shares


@pytest.fixture(scope="session")
def walk() -> Walk:
    size = Walk.size
    room, intrinsics = furnished_room(_INSIDE_M, seed=0, px_per_m=140), default_intrinsics(size)
    poses = smooth_trajectory(12, seed=5, inside_m=_INSIDE_M, step_deg=4.0)
    pictures = [render(room, intrinsics, pose, size)[0] for pose in poses]
    return Walk(poses, [cv2.imencode(".png", rgb[..., ::-1])[1].tobytes() for rgb in pictures], intrinsics)
