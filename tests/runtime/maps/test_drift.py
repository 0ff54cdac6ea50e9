"""Drift and lens: against poses that were moved by hand, SciPy's rotations and OpenCV's distortion."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.runtime.maps.absolute_pose import CameraPose
from mambaloc.runtime.maps.drift import NUGGET, Drift, fit_drift
from mambaloc.runtime.maps.lens import Lens


def _walk(count):
    angle = np.linspace(0, 2, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.column_stack((np.sin(angle), 0.1 * angle, np.cos(angle)))
    poses[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * np.array([0, 1, 0])).as_matrix()
    return poses


def _moved(poses, shift, turn):
    """By a shift and a turn along each camera's own axes."""
    given = poses.copy()
    given[:, :3, 3] += poses[:, :3, :3] @ shift
    given[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return given


def test_the_same_drift_of_all_key_frames_is_found_between_them_and_taken_back():
    adjusted = _walk(41)
    shift, turn = np.array([0.03, -0.01, 0.02]), np.array([0.01, -0.02, 0.005])
    given = _moved(adjusted, shift, turn)
    drift = Drift(adjusted[::2], *fit_drift(adjusted[::2], given[::2]))
    for row in range(1, 41, 8):
        pose = CameraPose(adjusted[row, :3, :3], adjusted[row, :3, 3])
        carried, _ = drift.to_given(pose)
        assert carried.position_m == pytest.approx(given[row, :3, 3], abs=1e-3)
        assert (
            Rotation.from_matrix(carried.rotation).inv() * Rotation.from_matrix(given[row, :3, :3])
        ).magnitude() < 1e-3
        back = drift.to_adjusted(carried)
        assert back.position_m == pytest.approx(pose.position_m, abs=1e-3)
        assert back.rotation == pytest.approx(pose.rotation, abs=1e-3)


def test_drift_is_surer_near_key_frames_than_far_off():
    adjusted = _walk(20)
    drift = Drift(adjusted, *fit_drift(adjusted, _moved(adjusted, np.array([0.03, 0, 0]), np.zeros(3))))
    near = drift.to_given(CameraPose(adjusted[5, :3, :3], adjusted[5, :3, 3]))[1]
    far = drift.to_given(CameraPose(-adjusted[5, :3, :3], adjusted[5, :3, 3] + 5))[1]
    assert np.trace(near[:3, :3]) < np.trace(far[:3, :3]) / 10
    assert np.linalg.eigvalsh(far).min() >= -1e-12


def test_no_drift_leaves_poses_alone():
    adjusted = _walk(10)
    pose = CameraPose(adjusted[3, :3, :3], adjusted[3, :3, 3] + 0.1)
    carried, covariance = Drift(adjusted, *fit_drift(adjusted, adjusted)).to_given(pose)
    assert carried.position_m == pytest.approx(pose.position_m, abs=1e-12)
    assert covariance == pytest.approx(0, abs=1e-12)


def test_noise_of_the_key_frames_is_not_taken_for_drift():
    """Of poses that were given exactly and adjusted with an error of 1 mm, another frame is off by that, not more."""
    adjusted, rng = _walk(60), np.random.default_rng(0)
    noise_m = rng.normal(0, 1e-3, (60, 3))
    given = adjusted.copy()
    given[:, :3, 3] += noise_m
    weights, nugget = fit_drift(adjusted, given)
    drift = Drift(adjusted, weights, nugget)
    between = CameraPose(adjusted[7, :3, :3], adjusted[7:9, :3, 3].mean(axis=0))
    carried, covariance = drift.to_given(between)
    assert np.linalg.norm(carried.position_m - between.position_m) < 5e-4
    assert np.sqrt(np.diag(covariance)[:3]) == pytest.approx(1e-3, rel=0.25)


def test_smooth_drift_has_a_small_nugget_and_is_followed():
    adjusted = _walk(60)
    given = adjusted.copy()
    given[:, :3, 3] += 0.05 * np.sin(3 * np.linspace(0, 2, 60))[:, None]
    weights, nugget = fit_drift(adjusted[::2], given[::2])
    assert nugget == NUGGET
    carried, _ = Drift(adjusted[::2], weights, nugget).to_given(CameraPose(adjusted[31, :3, :3], adjusted[31, :3, 3]))
    assert carried.position_m == pytest.approx(given[31, :3, 3], abs=2e-3)


def test_a_lens_is_opencvs_radial_distortion_and_is_undone():
    ideal = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    lens = Lens(0.97, -0.05)
    points = np.hstack((ideal, np.ones((50, 1))))
    expected = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), np.diag((0.97, 0.97, 1)), np.array([-0.05, 0, 0, 0])
    )[0]
    assert lens.distort(ideal) == pytest.approx(expected[:, 0], abs=1e-12)
    assert lens.undistort(lens.distort(ideal)) == pytest.approx(ideal, abs=1e-9)


def test_slopes_of_a_lens_are_its_differences():
    ideal, lens, step = np.array([[0.4, -0.3]]), Lens(0.97, -0.05), 1e-6
    by_ray, by_lens = lens.slopes(ideal)
    here = lens.distort(ideal)
    for axis, ahead in enumerate(step * np.eye(2)):
        moved, other = lens.distort(ideal + ahead), Lens(*(lens.numbers + ahead)).distort(ideal)
        assert by_ray[0, :, axis] == pytest.approx((moved - here)[0] / step, abs=1e-5)
        assert by_lens[0, :, axis] == pytest.approx((other - here)[0] / step, abs=1e-5)
