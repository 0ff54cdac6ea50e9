"""Map-free's scenes: poses against SciPy, cameras by hand, and every bad input named.

Guesses, made before the reference loader was looked up: poses are world-to-camera with the scalar first (right); pixels
count from the image's corner (wrong: the loader resizes them as counted from a pixel's centre).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.importing.registry import read_capture


@pytest.fixture
def names(walk):
    return [f"seq{int(row >= 5)}/frame_{row:05d}.png" for row in range(len(walk.pngs))]


@pytest.fixture
def source(walk, names, tmp_path):
    folder = tmp_path / "s00042"
    walk.write(folder, names)
    rotation = Rotation.from_matrix(walk.world_from_cam[:, :3, :3]).inv()
    translation = -rotation.apply(walk.world_from_cam[:, :3, 3])
    wxyz = np.roll(rotation.as_quat(), 1, axis=1)
    lines = [
        " ".join([name, *(f"{number:.16f}" for number in (*q, *t))])
        for name, q, t in zip(names, wxyz, translation, strict=True)
    ]
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    fx, fy, cx, cy = walk.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    lens = [f"{name} {fx} {fy} {cx} {cy} 320 240" for name in names]
    (folder / "intrinsics.txt").write_text("\n".join(lens) + "\n")
    (folder / "poses_device.txt").write_text("\n".join(lines[5:]) + "\n")
    return folder


def edit(path, change):
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def test_two_scans_are_read_and_their_pictures_agree(source, walk):
    capture = read_capture(source)
    assert (capture.kind, capture.unit) == ("map_free", "metre")
    assert capture.sequences == ("seq0",) * 5 + ("seq1",) * 7
    walk.is_agreed(capture)
    (camera,) = capture.cameras.values()
    assert camera.center_px == tuple(walk.intrinsics[:2, 2])
    assert capture.choices["not read"] == "poses_device.txt"


def test_each_picture_has_its_own_camera(source, names):
    edit(source / "intrinsics.txt", lambda lines: [f"{names[0]} 300 301 160 120 320 240", *lines[1:]])
    capture = read_capture(source)
    assert len(capture.cameras) == 2
    assert capture.cameras[capture.camera_of[0]].focal_px == (300, 301)


def test_kept_back_poses_and_lost_frames_have_none(source, names):
    edit(source / "poses.txt", lambda lines: [*lines[:6], f"{names[6]} 0 0 0 0 0 0 0", *lines[8:]])
    capture = read_capture(source)
    assert np.isnan(capture.world_from_cam[6]).any()
    assert not np.isnan(np.delete(capture.world_from_cam, 6, axis=0)).any()
    assert [image.name for image in capture.images_without_pose] == ["frame_00007.png"]


def test_a_scene_of_the_test_set_has_the_pose_of_its_reference_alone(source, names):
    zeros = [f"{name} 0 0 0 0 0 0 0" for name in names[1:]]
    edit(source / "poses.txt", lambda _: [f"{names[0]} 1 0 0 0 0 0 0", *zeros])
    capture = read_capture(source)
    assert capture.kind == "map_free"
    np.testing.assert_array_equal(capture.world_from_cam[0], np.eye(4))
    assert np.isnan(capture.world_from_cam[1:]).any(axis=(1, 2)).all()


def test_pictures_without_a_camera_have_none_at_all(source):
    edit(source / "intrinsics.txt", lambda lines: lines[1:])
    capture = read_capture(source)
    assert (capture.cameras, capture.camera_of) == ({}, None)
    assert capture.choices["cameras"] == "none: intrinsics.txt does not name every image"


@pytest.mark.parametrize(
    ("file", "line", "says"),
    [
        ("poses.txt", "seq0/frame_00000.png 1 0 0 0 0 0", "line 1: is not a line 'name qw qx qy qz tx ty tz'"),
        ("poses.txt", "../a.png 1 0 0 0 0 0 0", "names '../a.png', which is not a file inside"),
        ("intrinsics.txt", "seq0/frame_00000.png 0 300 160 120 320 240", "intrinsics.txt, line 1: a camera must have"),
        ("intrinsics.txt", "seq0/frame_00000.png 9 9 900 120 320 240", "principal point 900, 120 is far from"),
    ],
)
def test_bad_input_is_named_in_one_line(source, refused, file, line, says):
    edit(source / file, lambda lines: [line, *lines[1:]])
    refused(lambda folder: read_capture(folder, "map_free"), source, says)
