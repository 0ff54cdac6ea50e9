"""Poses in a bag: read back by rosbags, and covariances against sampled errors."""

from __future__ import annotations

import numpy as np
import pytest
from bag_writing import FIRST_NS, messages
from scipy.spatial.transform import Rotation

from mambaloc.bags.reading import is_bag
from mambaloc.bags.writing import TOPIC, covariance_of, moved, pose_bag
from mambaloc.errors import InputError
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.maps.radii import covariance_radius

POSITION, WXYZ = np.array([1.0, -2.0, 3.5]), np.array([0.5, -0.5, 0.5, 0.5])


@pytest.mark.parametrize("name", ["found.bag", "found"])
def test_poses_are_read_back(tmp_path, name):
    covariance = np.arange(36.0).reshape(6, 6)
    with pose_bag(tmp_path / name) as write:
        write(FIRST_NS, "hall", POSITION, WXYZ, covariance)
        write(FIRST_NS + 1, "den", POSITION, WXYZ, covariance)
    assert is_bag(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    first, second = messages(tmp_path / name, TOPIC)
    stamps = [each.header.stamp.sec * 10**9 + each.header.stamp.nanosec for each in (first, second)]
    assert stamps == [FIRST_NS, FIRST_NS + 1]
    assert (first.header.frame_id, second.header.frame_id) == ("hall", "den")
    at, turn = first.pose.pose.position, first.pose.pose.orientation
    assert (at.x, at.y, at.z) == tuple(POSITION)
    assert (turn.w, turn.x, turn.y, turn.z) == tuple(WXYZ)
    np.testing.assert_array_equal(first.pose.covariance, np.arange(36.0))


@pytest.mark.parametrize("name", ["found.bag", "found"])
def test_an_error_leaves_nothing_and_nothing_is_overwritten(tmp_path, name):
    with pytest.raises(ValueError, match="unpack"), pose_bag(tmp_path / name) as write:
        write(FIRST_NS, "map", POSITION, WXYZ[:3], np.eye(6))
    assert not list(tmp_path.iterdir())
    (tmp_path / name).touch()
    with pytest.raises(InputError, match="already exists"), pose_bag(tmp_path / name):
        pass


def test_a_covariance_has_the_radii_that_it_is_made_of():
    """Nine of ten sampled errors are within the radii, whose formula is within 3 % of the exact one."""
    covariance = covariance_of(Localization(POSITION, WXYZ, 0.0, 0.3, 4.0))
    assert covariance_radius(covariance[:3, :3]) == pytest.approx(0.3)
    assert np.degrees(covariance_radius(covariance[3:, 3:])) == pytest.approx(4.0)
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(6), covariance, 20_000)
    assert (np.linalg.norm(errors[:, :3], axis=1) < 0.3).mean() == pytest.approx(0.9, abs=0.01)
    assert (np.degrees(np.linalg.norm(errors[:, 3:], axis=1)) < 4.0).mean() == pytest.approx(0.9, abs=0.01)


def test_the_maps_covariance_is_written_as_it_is_and_none_without_radii():
    told = np.diag([1.0, 2, 3, 4, 5, 6])
    assert (covariance_of(Localization(POSITION, WXYZ, 0.0, 0.3, 4.0, covariance=told)) == told).all()
    assert covariance_of(Localization(POSITION, WXYZ, 0.0)) is None


def test_a_body_beside_the_camera_has_the_covariance_of_sampled_poses():
    """Errors of the camera, a shift and a turn about the world's axes, are applied one by one with SciPy."""
    rng = np.random.default_rng(1)
    root = rng.normal(0, 1, (6, 6)) * 0.01
    covariance, cam_from_body = root @ root.T, np.eye(4)
    cam_from_body[:3, :3] = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    cam_from_body[:3, 3] = 0.5, -1.5, 1.0
    position, quaternion, found = moved(POSITION, WXYZ, covariance, cam_from_body)
    rotation = Rotation.from_quat(np.roll(WXYZ, -1))
    expected = rotation * Rotation.from_matrix(cam_from_body[:3, :3])
    np.testing.assert_allclose(position, POSITION + rotation.apply(cam_from_body[:3, 3]), atol=1e-12)
    assert (expected.inv() * Rotation.from_quat(np.roll(quaternion, -1))).magnitude() < 1e-12
    errors = rng.multivariate_normal(np.zeros(6), covariance, 200_000)
    turns = Rotation.from_rotvec(errors[:, 3:])
    positions = POSITION + errors[:, :3] + (turns * rotation).apply(cam_from_body[:3, 3])
    turned = (turns * expected * expected.inv()).as_rotvec()
    sampled = np.cov(np.concatenate((positions, turned), axis=1).T)
    np.testing.assert_allclose(found, sampled, atol=0.03 * np.abs(sampled).max())
