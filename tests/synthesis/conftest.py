"""The embedded room with exact depth, filmed on a walk at 96x72."""

import numpy as np
import pytest

from mambaloc.rendering import default_intrinsics, embedded_room, embedded_walk, render
from mambaloc.synthesis import PosedDepth

SIZE = (96, 72)


def shoot(poses):
    room, intrinsics = embedded_room(), default_intrinsics(SIZE)
    shots = [render(room, intrinsics, pose, SIZE) for pose in poses]
    images = np.stack([picture.transpose(2, 0, 1) for picture, _ in shots])
    depth_m = np.stack([np.where(depth > 0, depth, np.nan) for _, depth in shots]).astype(np.float32)
    return PosedDepth(images, depth_m, np.repeat(intrinsics[None], len(poses), axis=0), poses)


@pytest.fixture(scope="session")
def shoot_room():
    """``shoot_room(poses)``: frames with exact depth from poses (N, 4, 4)."""
    return shoot


@pytest.fixture(scope="session")
def walk():
    """60 frames, once around."""
    return shoot(embedded_walk(60, 1, start_deg=0.0, step_deg=6.0))
