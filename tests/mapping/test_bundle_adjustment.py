"""Bundle adjustment against SciPy's least squares, and on poses whose errors are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mambaloc.mapping.bundle_adjustment import Prior, adjust
from mambaloc.mapping.triangulation import Observations

FRAMES, NEAR = 5, 0.02


@dataclass(frozen=True)
class Scene:
    """Cameras on an arc that look at points, and exactly where they see them."""

    cam_from_world: np.ndarray
    points: np.ndarray
    seen: Observations
    depth: np.ndarray


def film(frames, count):
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 2), (1, 1, 4), (count, 3))
    poses = np.tile(np.eye(4), (frames, 1, 1))
    angle = np.linspace(-0.3, 0.3, frames)
    poses[:, :3, :3] = Rotation.from_euler("y", -angle[:, None]).as_matrix()
    poses[:, :3, 3] = np.stack((3 * np.sin(angle), 0.1 * np.cos(9 * angle), 3 - 3 * np.cos(angle)), axis=1)
    cam_from_world = np.linalg.inv(poses)
    track, frame = np.divmod(np.flatnonzero(rng.uniform(size=count * frames) < 0.7), frames)
    twice = np.bincount(track, minlength=count)[track] >= 2
    kept, track = np.unique(track[twice], return_inverse=True)
    points, frame = points[kept], frame[twice]
    cam = np.einsum("oij,oj->oi", cam_from_world[frame, :3, :3], points[track]) + cam_from_world[frame, :3, 3]
    seen = Observations(frame, track, cam[:, :2] / cam[:, 2:], np.full(len(frame), NEAR))
    return Scene(cam_from_world, points, seen, cam[:, 2])


@pytest.fixture(scope="module")
def scene():
    return film(40, 200)


def disturbed(cam_from_world, turn_deg, move, seed=1):
    rng = np.random.default_rng(seed)
    poses = np.linalg.inv(cam_from_world)
    turns = Rotation.from_rotvec(np.radians(turn_deg) * rng.normal(size=(len(poses), 3))).as_matrix()
    poses[:, :3, :3] = turns @ poses[:, :3, :3]
    poses[:, :3, 3] += move * rng.normal(size=(len(poses), 3))
    return np.linalg.inv(poses)


def apart(cam_from_world, other):
    """Mean distance of camera centres, and mean turn in degrees."""
    first, second = np.linalg.inv(cam_from_world), np.linalg.inv(other)
    turn = Rotation.from_matrix(first[:, :3, :3]).inv() * Rotation.from_matrix(second[:, :3, :3])
    return np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1).mean(), np.degrees(turn.magnitude()).mean()


def test_the_least_squares_are_those_of_scipy():
    """The same residuals, stacked by hand, and minimised by SciPy with Cauchy's loss of each observation."""
    scene = film(FRAMES, 24)
    given = disturbed(scene.cam_from_world, 0.5, 0.01)
    noisy = Observations(
        scene.seen.frame,
        scene.seen.track,
        scene.seen.rays + 0.002 * np.random.default_rng(2).normal(size=scene.seen.rays.shape),
        scene.seen.near,
    )
    prior = Prior(given, np.radians(0.5), 0.01)
    found, points = adjust(given, noisy, scene.points, prior)
    weight = np.sqrt(np.maximum(np.bincount(noisy.frame, minlength=FRAMES), 20) / 20)

    def unpacked(x):
        turn, centre = x[: 3 * FRAMES].reshape(-1, 3), x[3 * FRAMES : 6 * FRAMES].reshape(-1, 3)
        rotation = Rotation.from_rotvec(turn) * Rotation.from_matrix(given[:, :3, :3])
        return rotation, turn, centre, x[6 * FRAMES :].reshape(-1, 3)

    given_centre = np.linalg.inv(given)[:, :3, 3]

    def residuals(x):
        rotation, turn, centre, points = unpacked(x)
        cam = rotation[noisy.frame].apply(points[noisy.track] - centre[noisy.frame])
        off = (cam[:, :2] / cam[:, 2:] - noisy.rays) * 2 / NEAR
        square = (off**2).sum(axis=1, keepdims=True) + 1e-12
        pull = np.concatenate((turn / prior.turn_rad, (centre - given_centre) / prior.move), axis=1)
        # Cauchy's cost of an observation as a square, so that SciPy minimises the same sum.
        cauchy = off * np.sqrt(np.log1p(square) / square)
        return np.concatenate((cauchy.ravel(), (pull * weight[:, None]).ravel()))

    start = np.concatenate((np.zeros(3 * FRAMES), given_centre.ravel(), scene.points.ravel()))
    ours = np.concatenate(
        (
            (Rotation.from_matrix(found[:, :3, :3]) * Rotation.from_matrix(given[:, :3, :3]).inv()).as_rotvec().ravel(),
            np.linalg.inv(found)[:, :3, 3].ravel(),
            points.ravel(),
        )
    )
    scipys = least_squares(residuals, start, method="trf")
    cost = (residuals(ours) ** 2).sum() / 2
    assert cost < 0.5 * (residuals(start) ** 2).sum() / 2
    assert cost == pytest.approx(scipys.cost, rel=5e-3)


def test_disturbed_poses_come_nearer_to_the_truth(scene):
    given = disturbed(scene.cam_from_world, 0.5, 0.02)
    found, _ = adjust(given, scene.seen, scene.points + 0.02, Prior(given, np.radians(1), 0.05))
    before, after = apart(scene.cam_from_world, given), apart(scene.cam_from_world, found)
    assert after[0] < 0.4 * before[0]
    assert after[1] < 0.4 * before[1]


def test_exact_poses_stay(scene):
    found, points = adjust(scene.cam_from_world, scene.seen, scene.points, Prior(scene.cam_from_world, 0.01, 0.03))
    assert max(apart(scene.cam_from_world, found)) < 1e-6
    np.testing.assert_allclose(points, scene.points, atol=1e-6)


def test_depth_holds_the_scale(scene):
    """Everything is a tenth too large, which no picture can contradict; depth can."""
    poses = np.linalg.inv(scene.cam_from_world)
    poses[:, :3, 3] *= 1.1
    given, loose = np.linalg.inv(poses), Prior(np.linalg.inv(poses), 1.0, 10.0)
    scales = []
    for depth in (None, scene.depth):
        found, _ = adjust(given, scene.seen, 1.1 * scene.points, loose, depth)
        scales.append(np.ptp(np.linalg.inv(found)[:, 0, 3]) / np.ptp(np.linalg.inv(scene.cam_from_world)[:, 0, 3]))
    assert scales[0] == pytest.approx(1.1, abs=1e-3)
    assert scales[1] == pytest.approx(1.0, abs=5e-3)
