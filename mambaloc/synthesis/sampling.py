"""Where views are rendered: around and between posed frames, thin parts of the trajectory as often as dense ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mambaloc.runtime.rotations import (
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rigid_transforms,
    rotation_vector_between,
)
from mambaloc.synthesis.posed_depth import Floats

_MAX_POSES = 2000  # pairs are a matrix


@dataclass(frozen=True)
class Spread:
    """How far views lie from the frames; lengths are in median depths of the scene, so any unit of the poses will do.

    Args:
        noise: standard deviation of each coordinate, of the nearer half of the views,
        noise_deg: and of the turn about each axis of the camera;
        far: of the other half both are so many times larger. Near ones give accuracy where the camera went; far ones
            teach it to answer where hardly a frame shows what it sees.
        between: views lie between two frames that are closer than this,
        between_deg: and turned by less than this.
        crowd: a frame counts as often as one over how many frames are closer than this,
        crowd_deg: and turned by less than this.
    """

    noise: float = 0.1
    noise_deg: float = 10.0
    far: float = 2.0
    between: float = 0.5
    between_deg: float = 40.0
    crowd: float = 0.1
    crowd_deg: float = 10.0


class PoseSampler:
    """Draws poses: one of the frames' or, as often, a point between two frames, plus normal noise of one
    of two sizes.

    Args:
        world_from_cam: of the frames, (N, 4, 4).
        scale_m: the scene's median depth.
        spread: how far from the frames.
    """

    def __init__(self, world_from_cam: Floats, scale_m: float, spread: Spread | None = None) -> None:
        rows = np.linspace(0, len(world_from_cam) - 1, min(len(world_from_cam), _MAX_POSES)).round().astype(int)
        self.spread, self.scale_m = spread or Spread(), scale_m
        self.position_m = world_from_cam[rows, :3, 3]
        self.quaternion = quaternion_from_matrix(world_from_cam[rows, :3, :3])
        distance = np.linalg.norm(self.position_m[:, None] - self.position_m, axis=-1) / scale_m
        turn_deg = np.degrees(2 * np.arccos(np.clip(np.abs(self.quaternion @ self.quaternion.T), 0, 1)))
        crowd = ((distance < self.spread.crowd) & (turn_deg < self.spread.crowd_deg)).sum(axis=1)
        self.share = (1 / crowd) / (1 / crowd).sum()
        self.is_near = (distance < self.spread.between) & (turn_deg < self.spread.between_deg)

    def draw(self, count: int, rng: np.random.Generator) -> Floats:
        """Draw poses, (``count``, 4, 4) ``world_from_cam``."""
        first = rng.choice(len(self.share), count, p=self.share)
        second = (self.is_near[first] * rng.uniform(size=(count, len(self.share)))).argmax(axis=1)
        way = rng.uniform(size=(count, 1)) * (rng.uniform(size=(count, 1)) < 0.5)
        turn = quaternion_from_rotation_vector(
            way * rotation_vector_between(self.quaternion[first], self.quaternion[second])
        )
        reach = np.where(rng.uniform(size=(count, 1)) < 0.5, self.spread.far, 1.0)
        noise_rad = reach * np.radians(self.spread.noise_deg) * rng.standard_normal((count, 3))
        quaternion = multiply(multiply(self.quaternion[first], turn), quaternion_from_rotation_vector(noise_rad))
        position_m = (1 - way) * self.position_m[first] + way * self.position_m[second]
        position_m += reach * self.spread.noise * self.scale_m * rng.standard_normal((count, 3))
        return rigid_transforms(matrix_from_quaternion(quaternion), position_m)
