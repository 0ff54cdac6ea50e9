"""What sampled poses are distributed like, measured with SciPy's rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.synthesis import PoseSampler, Spread


def posed(positions_m, yaws_deg):
    poses = np.tile(np.eye(4), (len(positions_m), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(yaws_deg, (0, 1, 0)), degrees=True).as_matrix()
    poses[:, :3, 3] = positions_m
    return poses


@pytest.mark.parametrize(("far", "factor"), [(1.0, 1.0), (3.0, np.sqrt((1 + 9) / 2))])
def test_noise_about_a_single_pose_is_as_told(far, factor):
    base = posed([[1.0, 2.0, 3.0]], [70.0])
    drawn = PoseSampler(base, 4.0, Spread(noise=0.05, noise_deg=6.0, far=far)).draw(4000, np.random.default_rng(0))
    shift = drawn[:, :3, 3] - base[0, :3, 3]
    turn = Rotation.from_matrix(base[0, :3, :3].T @ drawn[:, :3, :3])
    turn_deg = np.degrees(turn.as_rotvec())
    assert shift.mean(axis=0) == pytest.approx(0, abs=0.015 * factor)
    assert shift.std(axis=0) == pytest.approx(0.2 * factor, rel=0.05)
    assert turn_deg.mean(axis=0) == pytest.approx(0, abs=0.5 * factor)
    assert turn_deg.std(axis=0) == pytest.approx(6.0 * factor, rel=0.05)


def test_half_of_the_poses_lie_between_two_frames():
    still = Spread(noise=0.0, noise_deg=0.0)
    sampler = PoseSampler(posed([[0, 0, 0], [1.0, 0, 0]], [0, 30.0]), 4.0, still)
    drawn = sampler.draw(4000, np.random.default_rng(0))
    way = drawn[:, 0, 3]
    yaw_deg = Rotation.from_matrix(drawn[:, :3, :3]).as_euler("yxz", degrees=True)[:, 0]
    np.testing.assert_allclose(yaw_deg, 30 * way, atol=1e-6)  # turned as far as it is moved
    between = (way > 0) & (way < 1)
    assert between.mean() == pytest.approx(0.25, abs=0.03)  # the other of the two is the frame itself as often
    assert np.quantile(way[between], [0.25, 0.5, 0.75]) == pytest.approx([0.25, 0.5, 0.75], abs=0.05)


@pytest.mark.parametrize(("second_m", "yaw_deg"), [((2.5, 0, 0), 0.0), ((0.5, 0, 0), 50.0)])
def test_poses_do_not_lie_between_frames_that_are_far_apart(second_m, yaw_deg):
    sampler = PoseSampler(posed([[0, 0, 0], second_m], [0, yaw_deg]), 4.0, Spread(noise=0.0, noise_deg=0.0))
    assert set(sampler.draw(300, np.random.default_rng(0))[:, 0, 3]) <= {0.0, second_m[0]}


def test_place_that_was_filmed_long_is_drawn_as_often_as_one_that_was_filmed_once():
    positions = np.vstack((np.zeros((95, 3)), 10.0 * np.arange(1, 6)[:, None] * (1, 0, 0)))
    drawn = PoseSampler(posed(positions, np.zeros(100)), 1.0).draw(3000, np.random.default_rng(0))
    assert (drawn[:, 0, 3] < 5).mean() == pytest.approx(1 / 6, abs=0.03)


def test_unit_of_the_poses_does_not_matter():
    poses = posed(np.random.default_rng(1).normal(size=(20, 3)), np.arange(20.0))
    scaled = poses.copy()
    scaled[:, :3, 3] *= 70
    one = PoseSampler(poses, 2.0).draw(50, np.random.default_rng(3))
    other = PoseSampler(scaled, 140.0).draw(50, np.random.default_rng(3))
    np.testing.assert_allclose(other[:, :3, 3], 70 * one[:, :3, 3])
    np.testing.assert_allclose(other[:, :3, :3], one[:, :3, :3], atol=1e-12)
