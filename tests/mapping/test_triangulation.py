"""Robust triangulation of many tracks at once, against plain solutions of one track after another."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mambaloc.mapping.triangulation import Observations, triangulate

FRAMES, TRACKS, NEAR = 8, 40, 0.012


@pytest.fixture(scope="module")
def cameras():
    """Eight cameras on an arc, looking at what is around (0, 0, 4); ``cam_from_world``."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    for number, angle in enumerate(np.linspace(-0.4, 0.4, FRAMES)):
        poses[number, :3, :3] = Rotation.from_euler("y", -angle / 2).as_matrix()
        poses[number, :3, 3] = (3 * angle, 0.2 * (number % 2), 0)
    return np.linalg.inv(poses)


@pytest.fixture(scope="module")
def truth():
    return np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 5), (TRACKS, 3))


def _seen(cameras, truth, noise=0.0):
    """Every point in every camera."""
    cam = np.einsum("fij,tj->tfi", cameras[:, :3, :3], truth) + cameras[:, :3, 3]
    rays = cam[..., :2] / cam[..., 2:] + np.random.default_rng(1).normal(0, noise, (*cam.shape[:2], 2))
    track, frame = (each.ravel() for each in np.indices(rays.shape[:2]))
    return Observations(frame, track, rays.reshape(-1, 2), np.full(len(frame), NEAR))


def _by_svd(cameras, rays):
    rows = np.concatenate([rays[:, :1] * cameras[:, 2] - cameras[:, 0], rays[:, 1:] * cameras[:, 2] - cameras[:, 1]])
    solution = np.linalg.svd(rows)[2][-1]
    return solution[:3] / solution[3]


def test_exact_tracks_give_the_points_of_a_plain_svd(cameras, truth):
    seen = _seen(cameras, truth)
    points, is_point, agrees = triangulate(cameras, seen, np.random.default_rng(0))
    assert is_point.all()
    assert agrees.all()
    expected = [_by_svd(cameras, rays) for rays in seen.rays.reshape(TRACKS, FRAMES, 2)]
    np.testing.assert_allclose(points, expected, atol=1e-6)
    np.testing.assert_allclose(points, truth, atol=1e-6)


def test_noisy_tracks_give_the_least_squares_of_scipy(cameras, truth):
    """Of the views that agree: all but the one of 320 that the noise moved by more than four deviations."""
    seen = _seen(cameras, truth, noise=0.003)
    points, is_point, agrees = triangulate(cameras, seen, np.random.default_rng(0))
    assert is_point.all()
    assert agrees.sum() == len(seen) - 1

    def off(point, frames, rays):
        cam = cameras[frames, :3, :3] @ point + cameras[frames, :3, 3]
        return np.linalg.norm(cam[:, :2] / cam[:, 2:] - rays, axis=1)

    for track, (point, start) in enumerate(zip(points, truth, strict=True)):
        views = seen.select(agrees & (seen.track == track))
        # SciPy's Cauchy loss of each view's distance, with the same scale.
        best = least_squares(off, start, loss="cauchy", f_scale=NEAR / 2, args=(views.frame, views.rays), xtol=1e-12)
        np.testing.assert_allclose(point, best.x, atol=2e-4)


def test_wrong_views_are_dropped(cameras, truth):
    seen = _seen(cameras, truth, noise=0.001)
    is_wrong = np.isin(np.arange(len(seen)) % FRAMES, (1, 4, 6))
    rays = seen.rays + is_wrong[:, None] * np.random.default_rng(3).uniform(0.1, 0.3, (len(seen), 2))
    seen = Observations(seen.frame, seen.track, rays, seen.near)
    points, is_point, agrees = triangulate(cameras, seen, np.random.default_rng(0))
    assert is_point.all()
    np.testing.assert_array_equal(agrees, ~is_wrong)
    assert np.linalg.norm(points - truth, axis=1).max() < 0.05


def test_points_need_parallax_and_two_frames(cameras, truth):
    still = cameras.copy()
    still[:, :3, 3] = -still[:, :3, :3] @ (0.001, 0, 0) * np.arange(FRAMES)[:, None]  # hardly a move
    assert not triangulate(still, _seen(still, truth), np.random.default_rng(0))[1].any()
    seen = _seen(cameras, truth)
    one = Observations(np.zeros(len(seen), np.int64), seen.track, seen.rays, seen.near)
    assert not triangulate(cameras, one, np.random.default_rng(0))[1].any()


def test_points_behind_the_cameras_are_none(cameras, truth):
    """Rays that cross behind the cameras: those of points mirrored through them."""
    seen = _seen(cameras, truth * (1, 1, -1))
    assert not triangulate(cameras, seen, np.random.default_rng(0))[1].any()


def test_nothing_gives_nothing(cameras):
    nothing = Observations(np.empty(0, int), np.empty(0, int), np.empty((0, 2)), np.empty(0))
    points, is_point, agrees = triangulate(cameras, nothing, np.random.default_rng(0))
    assert (points.shape, is_point.shape, agrees.shape) == ((0, 3), (0,), (0,))
