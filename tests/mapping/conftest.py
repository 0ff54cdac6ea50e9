"""A rendered room with exact poses and depth, filmed on two walks at 160x120."""

from dataclasses import dataclass

import numpy as np
import pytest

from mambaloc.mapping import PosedFrames
from mambaloc.rendering import default_intrinsics, embedded_room, embedded_walk, render, sensor

SIZE = (160, 120)


@dataclass(frozen=True)
class Walk:
    """Frames, and the depth of each, (N, H, W) in metres."""

    frames: PosedFrames
    depth_m: np.ndarray


def film(count, seed):
    intrinsics, rng = default_intrinsics(SIZE), np.random.default_rng(seed)
    poses = embedded_walk(count, seed, start_deg=45.0 * seed, step_deg=360 / count)
    room = embedded_room()
    shots = [render(room, intrinsics, pose, SIZE) for pose in poses]
    images = [sensor(picture, rng) for picture, _ in shots]
    frames = PosedFrames(images, np.repeat(intrinsics[None], count, axis=0), poses)
    return Walk(frames, np.stack([depth for _, depth in shots]))


@pytest.fixture(scope="session")
def walk():
    """80 frames, once around."""
    return film(80, seed=1)


@pytest.fixture(scope="session")
def other_walk():
    """16 frames of another way through the same room."""
    return film(16, seed=2)
