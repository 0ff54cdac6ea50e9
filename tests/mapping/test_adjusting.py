"""Bundle adjustment against SciPy's least squares, and against cameras, points and a lens that are known."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mambaloc.mapping.adjusting import Bundle, adjust, moves
from mambaloc.mapping.triangulation import Observations
from mambaloc.runtime.maps.lens import Lens

DRIFT, SIGMA = (0.02, 0.01), 0.004


def _scene(lens, seed=0):
    """12 cameras on a line that look at 60 points, all of which they see."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, 3] = np.column_stack((np.linspace(-1, 1, 12), rng.normal(0, 0.2, (12, 2))))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.1, (12, 3))).as_matrix()
    points = rng.uniform((-1.5, -1, 3), (1.5, 1, 6), (60, 3))
    frame, track = np.tile(np.arange(12), 60), np.repeat(np.arange(60), 12)
    return poses, points, Observations(frame, track, _rays(poses, points, lens, frame, track), np.full(720, 0.1))


def _rays(poses, points, lens, frame, track):
    cam = np.einsum("oji,oj->oi", poses[frame, :3, :3], points[track] - poses[frame, :3, 3])
    ideal = cam[:, :2] / cam[:, 2:]
    return lens[0] * ideal * (1 + lens[1] * (ideal**2).sum(axis=1, keepdims=True))


def _drifted(poses, rng):
    moved = poses.copy()
    moved[:, :3, 3] += rng.normal(0, DRIFT[0], (12, 3))
    moved[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, DRIFT[1], (12, 3))).as_matrix() @ poses[:, :3, :3]
    return moved


def test_poses_and_a_lens_that_fit_are_found():
    """Residuals are 4.4 deviations before and 0.07 after, root mean square; the priors hold the rest."""
    poses, points, seen = _scene((0.97, -0.05))
    given = _drifted(poses, np.random.default_rng(1))
    found = adjust(Bundle(given, points + 0.05, Lens()), given, DRIFT, seen, SIGMA, is_lens_free=True)
    assert found.lens.numbers == pytest.approx((0.97, -0.05), abs=0.01)
    off = _rays(found.world_from_cam, found.points_m, found.lens.numbers, seen.frame, seen.track) - seen.rays
    assert np.sqrt((off**2).mean()) < 0.2 * SIGMA
    before = _rays(given, points, (1, 0), seen.frame, seen.track) - seen.rays
    assert np.sqrt((before**2).mean()) > 4 * SIGMA
    fixed = adjust(Bundle(given, points, Lens()), given, DRIFT, seen, SIGMA, is_lens_free=False)
    assert fixed.lens.numbers == pytest.approx((1, 0), abs=1e-6)


def test_the_least_cost_is_that_of_scipy():
    poses, points, seen = _scene((1.0, 0.0))
    rng = np.random.default_rng(2)
    given = _drifted(poses, rng)
    seen = Observations(seen.frame, seen.track, seen.rays + rng.normal(0, 0.001, seen.rays.shape), seen.near)
    found = adjust(Bundle(given, points, Lens()), given, DRIFT, seen, SIGMA, is_lens_free=False)
    deviations = np.repeat(DRIFT, 3)

    def residuals(numbers):
        at = given.copy()
        step = numbers[:72].reshape(12, 6)
        at[:, :3, 3] += step[:, :3]
        at[:, :3, :3] = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ given[:, :3, :3]
        off = np.linalg.norm(_rays(at, numbers[72:].reshape(-1, 3), (1, 0), seen.frame, seen.track) - seen.rays, axis=1)
        return np.concatenate((np.sqrt(np.log1p((off / SIGMA) ** 2)), (step / deviations).ravel()))

    def cost(bundle):
        numbers = np.concatenate((moves(given, bundle.world_from_cam).ravel(), bundle.points_m.ravel()))
        return (residuals(numbers) ** 2).sum(), numbers

    ours, numbers = cost(found)
    best = 2 * least_squares(residuals, numbers, max_nfev=10).cost
    assert ours < cost(Bundle(given, points, Lens()))[0] / 2
    assert ours <= best * 1.02
