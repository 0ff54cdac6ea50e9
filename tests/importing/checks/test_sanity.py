"""Checks of captures whose faults are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import capture_of, line, poses_at
from scipy.spatial.transform import Rotation

from mambaloc.importing.checks import sanity
from mambaloc.importing.checks.conventions import check_axes, check_up, up_of
from mambaloc.importing.checks.findings import Finding, verdict_of
from mambaloc.importing.motion import motion_of


def circle(count=60, radius=2.0, inwards=True, turns=1.0):
    angle = np.linspace(0, 2 * np.pi * turns, count, endpoint=False)
    position = radius * np.stack((np.cos(angle), np.sin(angle), np.zeros(count)), axis=1)
    return poses_at(position, np.degrees(angle) + (180 if inwards else 0))


# --- single poses ----------------------------------------------------------------------------------------------------


def test_poses_that_are_none_are_named():
    poses = poses_at(line(6))
    poses[1, 0, 3] = np.nan
    poses[2, :3, :3] *= 1.7
    poses[3, :3, 0] *= -1
    poses[4, 0, 0] += 0.1
    assert sanity.bad_poses(poses) == {
        1: "pose has NaN or infinite numbers",
        2: "pose's rotation is scaled by 1.7",
        3: "pose's rotation is left-handed: an axis is mirrored",
        4: "pose's rotation is not orthonormal",
    }


# --- which way is up, and where cameras look -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tilt_deg", "axis"), [((0, 0, 0), "+z"), ((90, 0, 0), "-y"), ((0, 90, 0), "+x"), ((180, 0, 0), "-z")]
)
def test_up_is_found_among_the_worlds_axes(tilt_deg, axis):
    poses = circle()
    poses[:, :3, :3] = Rotation.from_euler("xyz", tilt_deg, degrees=True).as_matrix() @ poses[:, :3, :3]
    up = up_of(capture_of(poses))
    assert up.axis == axis
    assert up.common == pytest.approx(1)
    assert up.off_deg == pytest.approx(0, abs=1e-5)
    assert up.world_axis @ up.direction == pytest.approx(1)


def test_a_tilted_world_has_no_axis_that_is_up():
    poses = circle()
    poses[:, :3, :3] = Rotation.from_euler("x", 35, degrees=True).as_matrix() @ poses[:, :3, :3]
    up = up_of(capture_of(poses))
    assert up.is_known
    assert up.world_axis is None
    assert up.off_deg == pytest.approx(35)
    assert "35° from +z" in check_up(capture_of(poses), up).message


def test_cameras_that_point_all_ways_know_no_up():
    poses = circle(200)
    poses[:, :3, :3] = Rotation.random(200, rng=np.random.default_rng(0)).as_matrix()
    finding = check_up(capture_of(poses), up_of(capture_of(poses)))
    assert finding.message.startswith("unknown")
    assert not finding.concern


def test_pictures_on_their_side():
    poses = circle()
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
    for pose, pitch in zip(poses, np.linspace(-60, 60, len(poses)), strict=True):
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("x", pitch, degrees=True).as_matrix()
    assert "lie on their side" in check_up(capture_of(poses), up_of(capture_of(poses))).concern
    assert not check_up(capture_of(poses), up_of(capture_of(poses)), are_contradicted=True).concern


@pytest.mark.parametrize(("inwards", "said"), [(True, "meet in front of"), (False, "meet behind")])
def test_where_optical_axes_meet(inwards, said):
    finding = check_axes(capture_of(circle(inwards=inwards)))
    assert finding.message.startswith(said)
    np.testing.assert_allclose(finding.figures["point"], 0, atol=1e-6)


def test_parallel_axes_meet_nowhere():
    assert check_axes(capture_of(poses_at(line(30)))).message == "parallel"


# --- steps, duplicates, times ----------------------------------------------------------------------------------------


def test_steps_and_a_jump():
    position = line(50)
    position[30:] += (0, 3, 0)
    capture = capture_of(poses_at(position, 2.0 * np.arange(50)))
    motion = motion_of(capture)
    assert motion.step == pytest.approx(0.1)
    assert motion.step_deg == pytest.approx(2)
    assert motion.in_order
    assert motion.jumps.tolist() == [30]
    assert "jumps 1 times (to 0030.png)" in sanity.check_steps(capture, motion, "m").concern


def test_a_step_between_sequences_is_none():
    position = line(50)
    position[30:] += (0, 3, 0)
    capture = capture_of(poses_at(position), sequences=("a",) * 30 + ("b",) * 20)
    motion = motion_of(capture)
    assert len(motion.length) == 48
    assert not len(motion.jumps)


def test_shuffled_frames_follow_no_path():
    order = np.random.default_rng(2).permutation(60)
    capture = capture_of(circle()[order])
    motion = motion_of(capture)
    assert not motion.in_order
    assert motion.step == pytest.approx(2 * 2.0 * np.sin(np.pi / 60))  # to the nearest frame
    assert "in no order of time" in sanity.check_steps(capture, motion, "m").concern


def test_a_pose_that_stays_is_named_with_its_frames():
    poses = poses_at(line(60))
    poses[50:] = poses[49]
    finding = sanity.check_duplicates(capture_of(poses), motion_of(capture_of(poses)))
    assert "most in a row 0049.png to 0059.png (11 frames): a tracker that is lost repeats" in finding.concern
    assert "take them and their poses out of the capture and import it again" in finding.concern
    split = capture_of(poses, sequences=tuple(f"seq-{row}" for row in range(60)))
    assert "successive" not in sanity.check_duplicates(split, motion_of(split)).concern
    assert not finding.is_fatal


def test_duplicates_are_counted():
    poses = poses_at(line(40))
    poses[10:16] = poses[9]
    finding = sanity.check_duplicates(capture_of(poses), motion_of(capture_of(poses)))
    assert finding.message == "6"
    assert "exactly the pose of another" in finding.concern
    poses[:] = poses[0]
    assert sanity.check_duplicates(capture_of(poses), motion_of(capture_of(poses))).is_fatal


@pytest.mark.parametrize(
    ("time_s", "concern"),
    [
        ([0, 1, 2, 3], ""),
        ([0, 2, 1, 3], "goes back 1 times and stands still 0"),
        ([0, 1, 1, 2], "back 0 times and stands still 1"),
    ],
)
def test_time_goes_forward(time_s, concern):
    finding = sanity.check_times(capture_of(poses_at(line(4)), time_s=np.array(time_s, dtype=float)))
    assert concern in finding.concern
    assert bool(finding.concern) == bool(concern)


def test_time_of_another_sequence_may_start_anew():
    capture = capture_of(poses_at(line(4)), time_s=np.array([5.0, 6, 0, 1]), sequences=("a", "a", "b", "b"))
    assert not sanity.check_times(capture).concern


# --- counts and the verdict ------------------------------------------------------------------------------------------


def test_too_few_frames_are_fatal():
    unposed = tuple(Path(f"{k}.png") for k in range(5))
    capture = capture_of(poses_at(line(12)), poses_without_image=("b",), images_without_pose=unposed)
    finding = sanity.check_frames(capture, {"a.png": "image is truncated"})
    assert finding.is_fatal
    assert "1 left out: image is truncated" in finding.message
    assert finding.concern == (
        "12 usable frames, and 20 are needed to train on some and to test on others (1 left out: image is truncated; "
        "1 poses without an image, as of b; 5 images without a pose, as 0.png, 1.png, 2.png, ...)"
    )


def test_what_is_missing_is_told():
    capture = capture_of(poses_at(line(30)), poses_without_image=("a", "b"), images_without_pose=(Path("x.png"),))
    finding = sanity.check_missing(capture)
    assert finding.message == "2 without image, 1 images without pose (a, b)"
    assert not finding.concern
    assert (
        "4 of 34 poses have no image"
        in sanity.check_missing(replace(capture, poses_without_image=tuple("abcd"))).concern
    )


def test_sizes_that_differ_are_told():
    finding = sanity.check_sizes([(64, 48)] * 3 + [(48, 64)])
    assert finding.message == "64x48 (3), 48x64 (1)"
    assert finding.concern


def test_the_verdict():
    fine, odd = Finding("a", "1"), Finding("b", "2", "b is odd")
    assert str(verdict_of([fine])) == "usable"
    assert str(verdict_of([fine, odd, Finding("c", "3", "c, too")])) == "usable, but b is odd; c, too"
    assert str(verdict_of([odd, Finding("c", "3", "no c", is_fatal=True)])) == "not usable: no c"
