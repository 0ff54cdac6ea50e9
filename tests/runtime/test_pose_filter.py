"""The pose filter against a linear Kalman filter, least squares over a whole track, and SciPy's rotations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.runtime import Noise, PoseFilter, smooth
from mambaloc.runtime.pose_filter import _boxplus, _predict

NOISE = Noise(position_m=0.1, rotation_deg=4.0)
ACCELERATION_M_S2, ACCELERATION_DEG_S2 = NOISE.acceleration_m_s2, NOISE.acceleration_deg_s2
POSITION, VELOCITY, ROTATION, TURN = (slice(start, start + 3) for start in range(0, 12, 3))


def irregular(count, seed=0):
    return np.cumsum(np.random.default_rng(seed).uniform(0.01, 0.08, count))


def wxyz(rotation):
    return rotation.as_quat(scalar_first=True)


def angle_deg(a, b):
    """Between two quaternions or stacks of them."""
    a, b = (Rotation.from_quat(q, scalar_first=True) for q in (a, b))
    return np.degrees((a.inv() * b).magnitude())


def hand_held(count=400, seed=0, position_m=0.1, rotation_deg=4.0, step_s=1 / 30):
    """Motion by white acceleration, and how it is measured: times, true and measured positions and quaternions."""
    rng = np.random.default_rng(seed)
    time_s = step_s * np.arange(count)
    velocity_m_s = np.cumsum(ACCELERATION_M_S2 * np.sqrt(step_s) * rng.normal(size=(count, 3)), axis=0)
    turn_rad_s = np.cumsum(np.radians(ACCELERATION_DEG_S2) * np.sqrt(step_s) * rng.normal(size=(count, 3)), axis=0)
    true_m = np.cumsum(step_s * velocity_m_s, axis=0)
    rotation, true = Rotation.random(random_state=seed), []
    for turn in turn_rad_s:
        rotation *= Rotation.from_rotvec(step_s * turn)
        true.append(wxyz(rotation))
    off = Rotation.from_rotvec(np.radians(rotation_deg) * rng.normal(size=(count, 3)))
    measured = wxyz(Rotation.from_quat(true, scalar_first=True) * off)
    measured *= rng.choice([-1, 1], (count, 1))
    return time_s, true_m, np.array(true), true_m + position_m * rng.normal(size=(count, 3)), measured


def update_each(time_s, position_m, quaternion, noise=NOISE):
    keep = PoseFilter(noise)
    return [keep.update(*pose) for pose in zip(time_s, position_m, quaternion, strict=True)]


def of(estimates, name):
    return np.stack([getattr(estimate, name) for estimate in estimates])


# --- against linear theory --------------------------------------------------------------------------------------------


def transition(step_s, acceleration):
    """Of a state of position and velocity along one axis (Bar-Shalom, Li and Kirubarajan 2001, 6.2.2)."""
    white = np.array([[step_s**3 / 3, step_s**2 / 2], [step_s**2 / 2, step_s]])
    return np.array([[1, step_s], [0, 1]]), acceleration**2 * white


def kalman(time_s, measured, deviation, acceleration, covariance):
    """A linear Kalman filter along one axis that begins with the first: states (N, 2), covariances (N, 2, 2)."""
    state = np.array([measured[0], 0.0])
    states, covariances = [state], [covariance]
    for step_s, value in zip(np.diff(time_s), measured[1:], strict=True):
        motion, process_noise = transition(step_s, acceleration)
        state, covariance = motion @ state, motion @ covariance @ motion.T + process_noise
        gain = covariance[:, 0] / (covariance[0, 0] + deviation**2)
        state = state + gain * (value - state[0])
        covariance = covariance - np.outer(gain, covariance[0])
        states.append(state)
        covariances.append(covariance)
    return np.array(states), np.array(covariances)


def least_squares(time_s, measured, deviation, acceleration, covariance):
    """All states of one axis at once, by the normal equations: what a smoother must find."""
    count = len(time_s)
    information, right = np.zeros((2 * count, 2 * count)), np.zeros(2 * count)
    information[:2, :2] = np.linalg.inv(covariance)
    right[:2] = information[:2, :2] @ (measured[0], 0)
    for k, step_s in enumerate(np.diff(time_s)):
        motion, process_noise = transition(step_s, acceleration)
        both = np.hstack([-motion, np.eye(2)])
        information[2 * k : 2 * k + 4, 2 * k : 2 * k + 4] += both.T @ np.linalg.inv(process_noise) @ both
        information[2 * k + 2, 2 * k + 2] += deviation**-2
        right[2 * k + 2] += measured[k + 1] / deviation**2
    covariances = np.linalg.inv(information).reshape(count, 2, count, 2)
    return np.linalg.solve(information, right).reshape(count, 2), covariances[range(count), :, range(count)]


@pytest.mark.parametrize(("run", "oracle"), [(update_each, kalman), (smooth, least_squares)])
def test_position_is_linear_theorys(run, oracle):
    time_s, rng = irregular(60), np.random.default_rng(1)
    measured_m = np.sin(time_s[:, None] * (0.2, 0.3, 0.4)) + 0.1 * rng.normal(size=(60, 3))
    estimates = run(time_s, measured_m, np.tile((1.0, 0, 0, 0), (60, 1)), NOISE)
    assert not any(estimate.is_outlier for estimate in estimates)
    covariance = np.diag(PoseFilter(NOISE).update(0, [0, 0, 0], [1, 0, 0, 0]).covariance[[0, 3], [0, 3]])
    for axis in range(3):
        states, covariances = oracle(time_s, measured_m[:, axis], 0.1, ACCELERATION_M_S2, covariance)
        np.testing.assert_allclose(of(estimates, "position_m")[:, axis], states[:, 0], atol=1e-8)
        np.testing.assert_allclose(of(estimates, "velocity_m_s")[:, axis], states[:, 1], atol=1e-7)
        rows = np.ix_(range(60), [axis, 3 + axis], [axis, 3 + axis])
        np.testing.assert_allclose(of(estimates, "covariance")[rows], covariances, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(("run", "oracle"), [(update_each, kalman), (smooth, least_squares)])
def test_rotation_about_one_axis_is_linear_theorys(run, oracle):
    """Through several turns, so that quaternions change their sign and angles wrap."""
    time_s, axis = irregular(120, seed=2), np.array([2, -1, 2]) / 3
    angle_rad = 4 * time_s + np.radians(4) * np.random.default_rng(3).normal(size=120)
    estimates = run(time_s, np.zeros((120, 3)), wxyz(Rotation.from_rotvec(angle_rad[:, None] * axis)), NOISE)
    assert not any(estimate.is_outlier for estimate in estimates)
    covariance = np.diag(PoseFilter(NOISE).update(0, [0, 0, 0], [1, 0, 0, 0]).covariance[[6, 9], [6, 9]])
    states, covariances = oracle(time_s, angle_rad, np.radians(4), np.radians(ACCELERATION_DEG_S2), covariance)
    expected = wxyz(Rotation.from_rotvec(states[:, :1] * axis))
    assert angle_deg(of(estimates, "quaternion"), expected).max() < 1e-5
    np.testing.assert_allclose(of(estimates, "angular_velocity_rad_s"), states[:, 1:] * axis, atol=1e-7)
    variance = np.einsum("i,nij,j->n", axis, of(estimates, "covariance")[:, ROTATION, ROTATION], axis)
    np.testing.assert_allclose(variance, covariances[:, 0, 0], rtol=1e-5)


def test_a_constant_turn_is_recovered():
    """About a slanted axis of the camera's own, from a slanted start."""
    time_s, turn_rad_s = irregular(200), np.array([0.5, -1.0, 0.8])
    true = Rotation.random(random_state=4) * Rotation.from_rotvec(time_s[:, None] * turn_rad_s)
    off = Rotation.from_rotvec(np.radians(2) * np.random.default_rng(5).normal(size=(200, 3)))
    calm = Noise(rotation_deg=2.0, acceleration_deg_s2=1.0)
    estimates = update_each(time_s, np.zeros((200, 3)), wxyz(true * off), calm)
    np.testing.assert_allclose(estimates[-1].angular_velocity_rad_s, turn_rad_s, atol=0.03)
    assert angle_deg(estimates[-1].quaternion, wxyz(true[-1])) < 1.0
    exact = update_each(time_s, np.zeros((200, 3)), wxyz(true), calm)
    np.testing.assert_allclose(exact[-1].angular_velocity_rad_s, turn_rad_s, atol=1e-4)


def test_errors_move_as_the_state_does():
    """The matrix that moves errors on is the derivative of the motion, but for the curvature of a turn."""
    estimate = PoseFilter(NOISE).update(0, [1, 2, 3], wxyz(Rotation.random(random_state=1)))
    estimate = replace(estimate, velocity_m_s=np.array([1.0, 2, 3]), angular_velocity_rad_s=np.array([1.0, -2, 2]))
    step_s, tiny = 0.1, 1e-6
    predicted, motion, _ = _predict(estimate, step_s, NOISE)
    after = Rotation.from_quat(predicted.quaternion, scalar_first=True)
    for column, error in enumerate(tiny * np.eye(12)):
        moved, *_ = _predict(_boxplus(estimate, error, estimate.covariance), step_s, NOISE)
        turned = (after.inv() * Rotation.from_quat(moved.quaternion, scalar_first=True)).as_rotvec()
        off = [moved.position_m - predicted.position_m, moved.velocity_m_s - predicted.velocity_m_s]
        derivative = (
            np.concatenate([*off, turned, moved.angular_velocity_rad_s - predicted.angular_velocity_rad_s]) / tiny
        )
        curved = step_s * np.linalg.norm(estimate.angular_velocity_rad_s) * step_s / 2 if column >= 9 else 0
        np.testing.assert_allclose(motion[:, column], derivative, atol=1e-6 + curved)


def test_covariances_say_how_far_off_it_is():
    """Squared errors in units of the covariance average to its 12 dimensions (Bar-Shalom's consistency)."""
    time_s, true_m, true, *measured = hand_held(600, seed=6)
    for estimates in (update_each(time_s, *measured), smooth(time_s, *measured, NOISE)):
        turned = Rotation.from_quat(of(estimates, "quaternion"), scalar_first=True).inv() * Rotation.from_quat(
            true, scalar_first=True
        )
        off = np.hstack([true_m - of(estimates, "position_m"), turned.as_rotvec()])
        rows = np.ix_(range(600), [0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])
        covariances = of(estimates, "covariance")
        squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances[rows]), off)
        assert 4.5 < squared.mean() < 7.5
        np.testing.assert_array_equal(covariances, covariances.swapaxes(1, 2))
        assert np.linalg.eigvalsh(covariances).min() > 0


def test_smoothing_is_nearer_than_filtering_is_nearer_than_measuring():
    time_s, true_m, true, measured_m, measured = hand_held()
    errors = [np.median(np.linalg.norm(measured_m - true_m, axis=1))], [np.median(angle_deg(measured, true))]
    for estimates in (update_each(time_s, measured_m, measured), smooth(time_s, measured_m, measured, NOISE)):
        errors[0].append(np.median(np.linalg.norm(of(estimates, "position_m") - true_m, axis=1)))
        errors[1].append(np.median(angle_deg(of(estimates, "quaternion"), true)))
    for measured_error, causal, smoothed in errors:
        assert smoothed < 0.8 * causal < 0.8 * 0.8 * measured_error


# --- noise that is learned --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step_s", [1 / 60, 1 / 30, 1 / 8])
def test_errors_are_learned_at_any_rate(step_s):
    """Twice what poses show, which of white errors is all; and a twentieth of them thrown away makes little of it."""
    time_s, _, _, measured_m, measured = hand_held(count := round(60 / step_s), seed=7, step_s=step_s)
    learned = Noise.learned(time_s, measured_m, measured)
    assert (learned.position_m, learned.rotation_deg) == pytest.approx((0.2, 8.0), rel=0.1)
    measured_m[np.random.default_rng(0).permutation(count)[: count // 20]] += 2
    assert Noise.learned(time_s, measured_m, measured).position_m == pytest.approx(0.2, rel=0.6)


def test_motion_is_not_taken_for_error():
    """At one pose in two seconds a hand's motion is most of what shows."""
    time_s, true_m, *_ = hand_held(400, seed=8, step_s=2.0)
    learned = Noise.learned(time_s, true_m, np.tile((1.0, 0, 0, 0), (400, 1)))
    off_m = true_m[1:-1] - (true_m[:-2] + true_m[2:]) / 2
    assert learned.position_m < 0.7 * 2 * off_m.std() / np.sqrt(1.5)
    assert learned.rotation_deg == 1


def test_a_large_scene_needs_no_tuning():
    time_s, true_m, _, measured_m, measured = hand_held(300, position_m=3.0)
    for estimates in (update_each(time_s, measured_m, measured, None), smooth(time_s, measured_m, measured)):
        assert of(estimates, "is_outlier")[100:].sum() <= 3
        errors_m = np.linalg.norm(of(estimates, "position_m") - true_m, axis=1)
        assert np.median(errors_m) < 0.5 * np.median(np.linalg.norm(measured_m - true_m, axis=1))


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_a_track_too_short_to_learn_from(count):
    time_s, *_, measured_m, measured = (values[:count] for values in hand_held(5))
    assert len(smooth(time_s, measured_m, measured)) == count
    assert len(update_each(time_s, measured_m, measured, None)) == count


def test_a_camera_at_rest_is_no_division_by_zero():
    estimates = update_each(irregular(40), np.ones((40, 3)), np.tile((1.0, 0, 0, 0), (40, 1)), None)
    np.testing.assert_allclose(estimates[-1].position_m, 1)
    assert not any(estimate.is_outlier for estimate in estimates)


# --- outliers, jumps, gaps --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [NOISE, None])
@pytest.mark.parametrize("run", [update_each, smooth])
def test_poses_thrown_away_are_left_out(run, noise):
    time_s, true_m, _, measured_m, measured = hand_held(400, seed=9)
    thrown = np.sort(np.random.default_rng(1).permutation(np.arange(20, 400))[:20])
    directions = np.random.default_rng(2).normal(size=(20, 3))
    measured_m[thrown] += 2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    estimates = run(time_s, measured_m, measured, noise)
    left_out = np.flatnonzero(of(estimates, "is_outlier"))
    assert set(thrown) <= set(left_out)
    assert len(left_out) <= 24
    assert np.linalg.norm(of(estimates, "position_m") - true_m, axis=1).max() < 0.6


def test_a_rotation_thrown_away_is_left_out():
    time_s, *_, measured_m, measured = hand_held(100)
    measured[50] = wxyz(Rotation.from_quat(measured[50], scalar_first=True) * Rotation.from_rotvec([0, 1, 0]))
    assert update_each(time_s, measured_m, measured)[50].is_outlier


@pytest.mark.parametrize("run", [update_each, smooth])
def test_a_jump_that_persists_is_followed(run):
    time_s, true_m, _, measured_m, measured = hand_held(100)
    true_m[50:] += 5
    measured_m[50:] += 5
    estimates = run(time_s, measured_m, measured, NOISE)
    begins = 54 if run is update_each else 50  # the fifth is believed; who knows the future, believes the first
    assert np.flatnonzero(of(estimates, "begins")).tolist() == [0, begins]
    errors_m = np.linalg.norm(of(estimates, "position_m") - true_m, axis=1)
    assert errors_m[:50].max() < 0.5
    assert errors_m[begins:].max() < 0.5


def test_a_gap_is_bridged():
    time_s, true_m, _, measured_m, measured = hand_held(200)
    time_s[100:] += 60
    measured_m[100:] += 40
    true_m[100:] += 40
    for estimates in (update_each(time_s, measured_m, measured), smooth(time_s, measured_m, measured, NOISE)):
        assert not of(estimates, "is_outlier")[100:].any()
        assert np.linalg.norm(of(estimates, "position_m") - true_m, axis=1).max() < 0.5


def test_two_poses_of_one_time_are_averaged():
    keep = PoseFilter(NOISE)
    keep.update(1.0, [0, 0, 0], [1, 0, 0, 0])
    both = keep.update(1.0, [0.2, 0, 0], wxyz(Rotation.from_euler("y", 6, degrees=True)))
    np.testing.assert_allclose(both.position_m, [0.1, 0, 0], atol=1e-12)
    assert angle_deg(both.quaternion, wxyz(Rotation.from_euler("y", 3, degrees=True))) < 1e-6
    np.testing.assert_allclose(both.covariance[POSITION, POSITION], np.eye(3) * 0.1**2 / 2)


def test_the_first_pose_is_given_back():
    quaternion = -wxyz(Rotation.from_euler("xyz", [0.1, 0.2, 3.0]))
    first = PoseFilter().update(0, [1, 2, 3], 7 * quaternion)
    np.testing.assert_allclose(first.position_m, [1, 2, 3])
    np.testing.assert_allclose(first.quaternion, -quaternion)
    assert first.begins
    assert first.quaternion[0] > 0


@pytest.mark.parametrize("run", [update_each, smooth])
def test_signs_and_lengths_of_quaternions_do_not_matter(run):
    time_s, *_, measured_m, measured = hand_held(60)
    scales = np.random.default_rng(0).uniform(0.5, 2, (60, 1)) * np.random.default_rng(1).choice([-1, 1], (60, 1))
    found = [of(run(time_s, measured_m, q, None), "quaternion") for q in (measured, scales * measured)]
    np.testing.assert_allclose(*found, atol=1e-9)


@pytest.mark.parametrize(
    "bad", [([np.nan, 0, 0], [1, 0, 0, 0]), ([0, 0, 0], [np.inf, 0, 0, 0]), ([0, 0, 0], [0, 0, 0, 0])]
)
def test_what_is_not_finite_is_an_outlier(bad):
    keep, other = PoseFilter(NOISE), PoseFilter(NOISE)
    with pytest.raises(InputError, match=r"pose at 0\.0 s: not finite"):
        keep.update(0.0, *bad)
    for time_s in (0.0, 0.1, 0.2):
        keep.update(time_s, [time_s, 0, 0], [1, 0, 0, 0])
        other.update(time_s, [time_s, 0, 0], [1, 0, 0, 0])
    skipped = keep.update(0.3, *bad)
    assert skipped.is_outlier
    assert np.isfinite(skipped.covariance).all()
    after, expected = (f.update(0.4, [0.4, 0, 0], [1, 0, 0, 0]) for f in (keep, other))
    np.testing.assert_allclose(after.position_m, expected.position_m, atol=1e-3)


def test_a_frame_that_is_not_finite_in_a_video_is_bridged():
    time_s, true_m, _, measured_m, measured = hand_held(100)
    measured_m[50] = np.nan
    smoothed = smooth(time_s, measured_m, measured)
    assert np.linalg.norm(of(smoothed, "position_m") - true_m, axis=1).max() < 0.5


def test_wrong_use_is_named():
    keep = PoseFilter()
    keep.update(1.0, [0, 0, 0], [1, 0, 0, 0])
    for time_s, position_m, quaternion, message in (
        (0.5, [0, 0, 0], [1, 0, 0, 0], r"0\.5 s: comes after 1\.0 s"),
        (np.nan, [0, 0, 0], [1, 0, 0, 0], "nan s: comes after"),
        (np.inf, [0, 0, 0], [1, 0, 0, 0], "inf s: comes after"),
        (2.0, [0, 0], [1, 0, 0, 0], r"shapes \(2,\) and \(4,\)"),
        (2.0, [0, 0, 0], np.eye(3), r"shapes \(3,\) and \(3, 3\)"),
    ):
        with pytest.raises(InputError, match=message):
            keep.update(time_s, position_m, quaternion)
    for value in (0, -1, np.nan, np.inf):
        with pytest.raises(InputError, match="rotation_deg"):
            Noise(rotation_deg=value)
    with pytest.raises(InputError, match="2 times, 3 positions"):
        smooth([0, 1], np.zeros((3, 3)), np.ones((3, 4)))
