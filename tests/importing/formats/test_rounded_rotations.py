"""Quaternions that are no units and matrices of five digits: made exact alike in every format, and stated once."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from captures import FLIP, line, poses_at
from scipy.spatial.transform import Rotation

from mambaloc.importing.registry import read_capture

COUNT = 12
POSES = poses_at(line(COUNT) + np.array((3, 2, 1)), 7.0 * np.arange(COUNT))
NAMES = [f"{row:03d}.png" for row in range(COUNT)]


def sevens(lengths, first=False, inverse=False):
    """Position and quaternion of each pose, the quaternion times a length."""
    poses = np.linalg.inv(POSES) if inverse else POSES
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat() * np.asarray(lengths)[:, None]
    return poses[:, :3, 3], np.roll(turns, 1, axis=1) if first else turns


def words(*numbers):
    return " ".join(repr(float(number)) for number in np.concatenate(numbers))


def write_tum(folder, lengths):
    rows = zip(*sevens(lengths), strict=True)
    lines = [f"{row} {words(position, turn)}" for row, (position, turn) in enumerate(rows)]
    (folder / "trajectory.txt").write_text("\n".join(lines))


def write_lines(folder, lengths):
    rows = zip(NAMES, *sevens(lengths, first=True, inverse=True), strict=True)
    (folder / "poses.txt").write_text("".join(f"{name} {words(turn, at)}\n" for name, at, turn in rows))


def write_csv(folder, lengths):
    rows = zip(NAMES, *sevens(lengths, first=True), strict=True)
    lines = [",".join([f"images/{name}", *words(at, turn).split()]) for name, at, turn in rows]
    (folder / "poses.csv").write_text("\n".join(["image,x,y,z,qw,qx,qy,qz", *lines]))


def write_colmap(folder, lengths):
    pytest.importorskip("pycolmap", reason="pycolmap, the extra [colmap], reads the models")
    (folder / "sparse").mkdir()
    (folder / "sparse/cameras.txt").write_text("1 PINHOLE 32 24 30 30 16 12\n")
    rows = zip(NAMES, *sevens(lengths, first=True, inverse=True), strict=True)
    lines = [f"{row} {words(turn, at)} 1 {name}\n\n" for row, (name, at, turn) in enumerate(rows, start=1)]
    (folder / "sparse/images.txt").write_text("".join(lines))


def write_kitti(folder, digits):
    (folder / "poses.txt").write_text("\n".join(words(pose[:3].ravel()) for pose in POSES.round(digits)))


def write_nerfstudio(folder, digits):
    matrices = (POSES @ FLIP).round(digits).tolist()
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": each} for name, each in zip(NAMES, matrices, strict=True)
    ]
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))


def write_pose_files(folder, digits):
    for name, pose in zip(NAMES, POSES.round(digits), strict=True):
        np.savetxt((folder / "images" / name).with_suffix(".txt"), pose)


OF_QUATERNIONS = [write_tum, write_lines, write_csv, write_colmap]
OF_MATRICES = [write_kitti, write_nerfstudio, write_pose_files]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "images").mkdir()
    for name in NAMES:
        cv2.imwrite(str(tmp_path / "images" / name), np.zeros((24, 32, 3), np.uint8))
    return tmp_path


@pytest.mark.parametrize("write", OF_QUATERNIONS)
@pytest.mark.parametrize("length", [0.5, 1.9])
def test_quaternions_of_another_length_are_made_units(folder, write, length):
    write(folder, [length] * COUNT)
    capture = read_capture(folder)
    np.testing.assert_allclose(capture.world_from_cam, POSES, atol=1e-12)
    assert capture.choices["quaternions"].startswith(f"{COUNT} of {COUNT} were not of unit length")
    assert f"at most {abs(length - 1):.2g} off" in capture.choices["quaternions"]


@pytest.mark.parametrize("write", OF_QUATERNIONS)
def test_a_quaternion_that_is_none_is_left_out_and_a_long_one_is_not(folder, write):
    write(folder, [1.0, 1.3, *[1.0] * 8, 0.1, 1.0])
    capture = read_capture(folder)
    np.testing.assert_allclose(capture.world_from_cam, np.delete(POSES, 10, axis=0), atol=1e-12)
    assert capture.choices["quaternions"].startswith(f"1 of {COUNT} were not of unit length")
    ((file, rule),) = capture.left_out.items()
    assert file.endswith("010.png")
    assert rule.startswith("the quaternion is far from unit length (")


@pytest.mark.parametrize("write", OF_MATRICES)
def test_matrices_of_five_digits_are_made_exact(folder, write):
    write(folder, 5)
    capture = read_capture(folder)
    np.testing.assert_allclose(capture.world_from_cam, POSES, atol=1.5e-5)
    turns = capture.world_from_cam[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.swapaxes(1, 2), np.tile(np.eye(3), (COUNT, 1, 1)), atol=1e-14)
    assert "were not orthonormal, and made so; at most" in capture.choices["rotations"]


@pytest.mark.parametrize("write", OF_MATRICES)
def test_exact_matrices_are_not_mentioned(folder, write):
    write(folder, 17)
    capture = read_capture(folder)
    np.testing.assert_allclose(capture.world_from_cam, POSES, atol=1e-12)
    assert "rotations" not in capture.choices
