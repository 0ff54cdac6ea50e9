"""Bundle adjustment against SciPy's least squares, and on poses, points and a lens that are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mambaloc.mapping.adjusting import Bundle, adjust
from mambaloc.mapping.triangulation import Observations

FRAMES, SIGMA = 5, 0.01
DRIFT = (0.01, np.radians(0.5))


@dataclass(frozen=True)
class Scene:
    """Cameras on an arc that look at points, and exactly where they see them."""

    world_from_cam: np.ndarray
    points: np.ndarray
    seen: Observations
    depth: np.ndarray

    def adjusted(self, given, points, drift=DRIFT, depth=None):
        return adjust(Bundle(given, points), given, drift, self.seen, SIGMA, depth_m=depth)


def film(frames, count, noise=0.0):
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 2), (1, 1, 4), (count, 3))
    poses = np.tile(np.eye(4), (frames, 1, 1))
    angle = np.linspace(-0.3, 0.3, frames)
    poses[:, :3, :3] = Rotation.from_euler("y", -angle[:, None]).as_matrix()
    poses[:, :3, 3] = np.stack((3 * np.sin(angle), 0.1 * np.cos(9 * angle), 3 - 3 * np.cos(angle)), axis=1)
    track, frame = np.divmod(np.flatnonzero(rng.uniform(size=count * frames) < 0.7), frames)
    twice = np.bincount(track, minlength=count)[track] >= 2
    kept, track = np.unique(track[twice], return_inverse=True)
    points, frame = points[kept], frame[twice]
    cam = np.einsum("oji,oj->oi", poses[frame, :3, :3], points[track] - poses[frame, :3, 3])
    rays = cam[:, :2] / cam[:, 2:] + noise * rng.normal(size=(len(cam), 2))
    return Scene(poses, points, Observations(frame, track, rays, np.full(len(frame), 0.02)), cam[:, 2])


@pytest.fixture(scope="module")
def scene():
    return film(40, 200)


def disturbed(world_from_cam, turn_deg, move, seed=1):
    rng, poses = np.random.default_rng(seed), world_from_cam.copy()
    turns = Rotation.from_rotvec(np.radians(turn_deg) * rng.normal(size=(len(poses), 3))).as_matrix()
    poses[:, :3, :3] = turns @ poses[:, :3, :3]
    poses[:, :3, 3] += move * rng.normal(size=(len(poses), 3))
    return poses


def apart(first, second):
    """Mean distance of camera centres, and mean turn in degrees."""
    turn = Rotation.from_matrix(first[:, :3, :3]).inv() * Rotation.from_matrix(second[:, :3, :3])
    return np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1).mean(), np.degrees(turn.magnitude()).mean()


@pytest.mark.parametrize("with_depth", [False, True])
def test_the_least_squares_are_those_of_scipy(with_depth):
    """The same residuals, stacked by hand; measured: costs that differ by less than 0.1 %."""
    scene = film(FRAMES, 24, noise=0.003)
    seen, given = scene.seen, disturbed(scene.world_from_cam, 0.5, 0.01)
    depth = np.where(np.arange(len(seen)) % 3 == 0, 1.01 * scene.depth, np.nan) if with_depth else None
    found = scene.adjusted(given, scene.points, depth=depth)

    def residuals(x):
        turn, center, points = np.split(x, (3 * FRAMES, 6 * FRAMES))
        turn, center, points = (each.reshape(-1, 3) for each in (turn, center, points))
        rotation = Rotation.from_rotvec(turn) * Rotation.from_matrix(given[:, :3, :3])
        cam = rotation[seen.frame].inv().apply(points[seen.track] - center[seen.frame])
        off = (cam[:, :2] / cam[:, 2:] - seen.rays) / SIGMA
        if depth is not None:
            off = np.column_stack((off, np.where(np.isfinite(depth), (cam[:, 2] / depth - 1) / 0.02, 0)))
        square = (off**2).sum(axis=1, keepdims=True) + 1e-12
        cauchy = off * np.sqrt(np.log1p(square) / square)  # whose squares sum to Cauchy's cost
        return np.concatenate(
            (cauchy.ravel(), (turn / DRIFT[1]).ravel(), ((center - given[:, :3, 3]) / DRIFT[0]).ravel())
        )

    turn = Rotation.from_matrix(found.world_from_cam[:, :3, :3]) * Rotation.from_matrix(given[:, :3, :3]).inv()
    ours = np.concatenate((turn.as_rotvec().ravel(), found.world_from_cam[:, :3, 3].ravel(), found.points_m.ravel()))
    start = np.concatenate((np.zeros(3 * FRAMES), given[:, :3, 3].ravel(), scene.points.ravel()))
    cost, before = ((residuals(x) ** 2).sum() / 2 for x in (ours, start))
    assert cost < 0.6 * before
    assert cost == pytest.approx(least_squares(residuals, start).cost, rel=3e-3)


def test_disturbed_poses_come_nearer_to_the_truth(scene):
    given = disturbed(scene.world_from_cam, 0.5, 0.02)
    found = scene.adjusted(given, scene.points + 0.02, (0.05, np.radians(1))).world_from_cam
    before, after = apart(scene.world_from_cam, given), apart(scene.world_from_cam, found)
    assert after[0] < 0.4 * before[0]
    assert after[1] < 0.4 * before[1]


def test_exact_poses_stay(scene):
    found = scene.adjusted(scene.world_from_cam, scene.points)
    assert max(apart(scene.world_from_cam, found.world_from_cam)) < 1e-6
    np.testing.assert_allclose(found.points_m, scene.points, atol=1e-6)


def test_depth_holds_the_scale(scene):
    """Everything is a tenth too large, which no image can contradict; depth can."""
    given = scene.world_from_cam.copy()
    given[:, :3, 3] *= 1.1
    scales = []
    for depth in (None, scene.depth):
        found = scene.adjusted(given, 1.1 * scene.points, (10.0, 1.0), depth).world_from_cam
        scales.append(np.ptp(found[:, 0, 3]) / np.ptp(scene.world_from_cam[:, 0, 3]))
    assert scales[0] == pytest.approx(1.1, abs=1e-3)
    assert scales[1] == pytest.approx(1.0, abs=5e-3)


def test_a_lens_that_fits_is_found():
    """Residuals are 4.4 deviations before and 0.07 after, root mean square; the priors hold the rest."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, 3] = np.column_stack((np.linspace(-1, 1, 12), rng.normal(0, 0.2, (12, 2))))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.1, (12, 3))).as_matrix()
    points = rng.uniform((-1.5, -1, 3), (1.5, 1, 6), (60, 3))
    frame, track = np.tile(np.arange(12), 60), np.repeat(np.arange(60), 12)

    def rays(poses, points, focal, radial):
        cam = np.einsum("oji,oj->oi", poses[frame, :3, :3], points[track] - poses[frame, :3, 3])
        ideal = cam[:, :2] / cam[:, 2:]
        return focal * ideal * (1 + radial * (ideal**2).sum(axis=1, keepdims=True))

    seen = Observations(frame, track, rays(poses, points, 0.97, -0.05), np.full(720, 0.1))
    given, drift, sigma, rng = poses.copy(), (0.02, 0.01), 0.004, np.random.default_rng(1)
    given[:, :3, 3] += rng.normal(0, drift[0], (12, 3))
    given[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, drift[1], (12, 3))).as_matrix() @ poses[:, :3, :3]
    found = adjust(Bundle(given, points + 0.05), given, drift, seen, sigma, np.zeros(12, np.int64))
    assert found.lenses[0].numbers == pytest.approx((0.97, -0.05), abs=0.01)
    off = rays(found.world_from_cam, found.points_m, *found.lenses[0].numbers) - seen.rays
    assert np.sqrt((off**2).mean()) < 0.2 * sigma
    assert np.sqrt(((rays(given, points, 1, 0) - seen.rays) ** 2).mean()) > 4 * sigma
    # The same observations as if of two cameras, of which the second has the pinhole that it claims.
    second = frame >= 6
    both = np.where(second[:, None], rays(poses, points, 1, 0), seen.rays)
    cameras, lenses = (np.arange(12) >= 6).astype(np.int64), 2 * Bundle(given, points).lenses
    start = Bundle(given, points + 0.05, lenses)
    found = adjust(start, given, drift, replace(seen, rays=both), sigma, cameras)
    assert found.lenses[0].numbers == pytest.approx((0.97, -0.05), abs=0.01)
    assert found.lenses[1].numbers == pytest.approx((1, 0), abs=0.01)
    fixed = adjust(Bundle(given, points), given, drift, seen, sigma)
    assert fixed.lenses[0].numbers == pytest.approx((1, 0), abs=1e-6)
