"""Poses from points, against SciPy's optimiser and a Monte Carlo."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mambaloc.runtime.maps.absolute_pose import CameraPose, focal_scale, pose_covariance, ransac_pose, refine_pose

NEAR = 0.02
TRUE = CameraPose(Rotation.from_rotvec((0.3, -0.5, 0.2)).as_matrix(), np.array((1.0, -0.5, 0.7)))


def _matches(count, noise, rng):
    points_m = rng.uniform((-1, -1, 2), (1, 1, 5), (count, 3)) @ TRUE.rotation.T + TRUE.position_m
    return points_m, TRUE.project(points_m)[0] + rng.normal(0, noise, (count, 2))


def _apart(pose):
    turn = Rotation.from_matrix(pose.rotation @ TRUE.rotation.T)  # about the axes of the world
    return np.concatenate((pose.position_m - TRUE.position_m, turn.as_rotvec()))


def test_refinement_is_scipys_minimum():
    points_m, rays = _matches(60, 0.003, np.random.default_rng(0))
    rays[:6] += 0.05  # wrong, so that the weights matter

    def off(step):
        rotation = Rotation.from_rotvec(step[3:]).as_matrix() @ TRUE.rotation
        return np.linalg.norm(CameraPose(rotation, TRUE.position_m + step[:3]).project(points_m)[0] - rays, axis=1)

    best = least_squares(off, np.zeros(6), loss="cauchy", f_scale=NEAR / 2, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    start = CameraPose(Rotation.from_rotvec((0.05, 0, 0.05)).as_matrix() @ TRUE.rotation, TRUE.position_m + 0.1)
    pose = refine_pose(start, points_m, rays, NEAR)
    np.testing.assert_allclose(_apart(pose), best.x, atol=2e-5)


@pytest.mark.parametrize("noise", [0.001, 0.006])
def test_covariance_is_that_of_a_monte_carlo(noise):
    """Its order and frame, too: noise is drawn 500 times, and errors are taken about the world's axes.

    The larger noise is that of a search around a pose, where residuals are as large as the scale of Cauchy's weights.
    """
    rng = np.random.default_rng(1)
    points_m, exact = _matches(80, 0.0, rng)
    errors, covariances = [], []
    for _ in range(500):
        rays = exact + rng.normal(0, noise, exact.shape)
        pose = refine_pose(TRUE, points_m, rays, NEAR)
        errors.append(_apart(pose))
        covariances.append(pose_covariance(pose, points_m, rays, NEAR))
    measured, said = np.cov(np.array(errors).T), np.mean(covariances, axis=0)
    # In the measured one's own units: the identity, as far as 500 draws tell.
    whitened = np.linalg.solve(np.linalg.cholesky(said), np.linalg.solve(np.linalg.cholesky(said), measured).T)
    np.testing.assert_allclose(whitened, np.eye(6), atol=0.25)


@pytest.mark.parametrize("scale", [1.0, 1.03, 0.95])
def test_a_focal_length_is_found_with_its_deviation(scale):
    """By 200 draws of noise: the mean is the true scale, and errors are as large as is said; smaller if it is off."""
    rng = np.random.default_rng(3)
    points_m, exact = _matches(200, 0.0, rng)
    found = []
    for _ in range(200):
        rays = scale * exact + rng.normal(0, 0.001, exact.shape)
        found.append(focal_scale(refine_pose(TRUE, points_m, rays, NEAR), points_m, rays, NEAR))
    scales, deviations = np.array(found).T
    assert np.mean(scales) == pytest.approx(scale, abs=0.15 * abs(scale - 1) + 2e-3)  # one step, which falls short
    assert np.std(scales) < 1.25 * np.mean(deviations)
    assert scale != 1 or np.std(scales) > 0.75 * np.mean(deviations)


def test_points_behind_the_camera_say_nothing_of_pose_and_focal_length():
    points_m, rays = _matches(20, 0.0, np.random.default_rng(0))
    points_m[0] = TRUE.position_m - TRUE.rotation[:, 2]
    assert focal_scale(TRUE, points_m, rays, NEAR) == (1.0, np.inf)
    assert np.isinf(pose_covariance(TRUE, points_m, rays, NEAR)).all()


def test_ransac_finds_the_pose_among_wrong_matches():
    rng = np.random.default_rng(2)
    points_m, rays = _matches(100, 0.001, rng)
    rays[:60] = rng.uniform(-0.4, 0.4, (60, 2))
    pose = ransac_pose(points_m, rays, NEAR / 2, rng)
    assert pose is not None
    assert np.abs(_apart(pose)).max() < 0.02


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_matches_give_no_pose(count):
    assert ransac_pose(*_matches(count, 0, np.random.default_rng(0)), NEAR, np.random.default_rng(0)) is None


def test_matches_of_one_point_give_no_pose():
    points_m, rays = (np.repeat(each[:1], 20, axis=0) for each in _matches(1, 0, np.random.default_rng(0)))
    assert ransac_pose(points_m, rays, NEAR, np.random.default_rng(0)) is None


def test_projection_is_that_of_a_pinhole():
    points_m = np.random.default_rng(0).uniform(-3, 3, (50, 3))
    seen, depth_m = TRUE.project(points_m)
    cam = Rotation.from_matrix(TRUE.rotation).inv().apply(points_m - TRUE.position_m)
    front = cam[:, 2] > 1e-9
    np.testing.assert_allclose(seen[front], cam[front, :2] / cam[front, 2:], rtol=1e-9)
    np.testing.assert_allclose(depth_m[front], cam[front, 2])
    assert np.isnan(seen[~front]).all()
    assert np.isnan(depth_m[~front]).all()
