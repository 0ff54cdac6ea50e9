"""A rendered room with exact poses and depth, filmed on two walks at 160x120."""

from dataclasses import dataclass

import numpy as np
import pytest

from mambaloc.mapping import MapSettings, PosedFrames, build_map
from mambaloc.rendering import default_intrinsics, embedded_room, embedded_walk, render, sensor

SIZE = (160, 120)


@dataclass(frozen=True)
class Walk:
    """Frames, and the depth of each, (N, H, W) in metres."""

    frames: PosedFrames
    depth_m: np.ndarray


def film(count, seed):
    return shoot(embedded_walk(count, seed, start_deg=45.0 * seed, step_deg=360 / count), seed)


def shoot(poses, seed):
    intrinsics, rng = default_intrinsics(SIZE), np.random.default_rng(seed)
    room = embedded_room()
    shots = [render(room, intrinsics, pose, SIZE) for pose in poses]
    images = [sensor(picture, rng) for picture, _ in shots]
    frames = PosedFrames(images, np.repeat(intrinsics[None], len(poses), axis=0), poses)
    return Walk(frames, np.stack([depth for _, depth in shots]))


@pytest.fixture(scope="session")
def film_of():
    """``film_of(poses, seed)``: frames of the room from poses, (N, 4, 4)."""
    return shoot


@pytest.fixture(scope="session")
def walk():
    """80 frames, once around."""
    return film(80, seed=1)


@pytest.fixture(scope="session")
def other_walk():
    """16 frames of another way through the same room."""
    return film(16, seed=2)


@pytest.fixture(scope="session")
def part(walk):
    """A map of the walk's first half, of which one sees the first half of the room."""
    return build_map(walk.frames.select(np.arange(0, 40, 2)), MapSettings(key_frames=20, width=160), "room")
