"""The layout of DSAC*, ACE and Wayspots: a camera for each image, and every bad input named.

Guess, made before the loader was looked up: the principal point counts from the image's corner (right: it is scaled as
the focal length is).
"""

from __future__ import annotations

import numpy as np
import pytest

from mambaloc.importing.registry import read_capture


@pytest.fixture
def source(walk, tmp_path):
    """The first eight frames to train on, the others to test on."""
    for number, pose in enumerate(walk.world_from_cam):
        folder = tmp_path / ("train" if number < 8 else "test")
        for name in ("rgb", "poses", "calibration"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        (folder / f"rgb/frame_{number:05d}.png").write_bytes(walk.pngs[number])
        np.savetxt(folder / f"poses/frame_{number:05d}.txt", pose, fmt="%.12f")
        (folder / f"calibration/frame_{number:05d}.txt").write_text(f"{walk.intrinsics[0, 0]}\n")
    return tmp_path


def by_name(capture):
    """Rows in the order of the walk: the folders come by name."""
    return np.argsort([image.name for image in capture.images])


def test_a_focal_length_for_each_picture(source, walk):
    capture = read_capture(source)
    assert capture.kind == "pose_files"
    order = by_name(capture)
    np.testing.assert_allclose(capture.world_from_cam[order], walk.world_from_cam, atol=1e-6)
    assert [capture.split[row] for row in order] == ["train"] * 8 + ["test"] * 4
    (camera,) = capture.cameras.values()
    assert camera.focal_px == pytest.approx((walk.intrinsics[0, 0],) * 2)
    assert camera.center_px == (159.5, 119.5)


def test_pictures_agree_with_the_cameras(source, walk):
    for folder in ("rgb", "poses", "calibration"):  # all in one sequence, in the walk's order
        for file in (source / "test" / folder).iterdir():
            file.rename(source / "train" / folder / file.name)
        (source / "test" / folder).rmdir()
    walk.is_agreed(read_capture(source))


def test_a_matrix_is_a_camera_of_its_own(source):
    (source / "test/calibration/frame_00009.txt").write_text("300 0 161\n0 301 121.5\n0 0 1\n")
    capture = read_capture(source)
    row = [image.name for image in capture.images].index("frame_00009.png")
    camera = capture.cameras[capture.camera_of[row]]
    assert (camera.focal_px, camera.center_px) == ((300, 301), (160.5, 121))
    assert len(capture.cameras) == 2


def test_another_number_of_files_is_said(source):
    (source / "test/calibration/frame_00009.txt").unlink()
    capture = read_capture(source)
    assert capture.cameras == {}
    assert "calibration has 3 files, and" in capture.choices["cameras"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("wide", "is neither a focal length nor a 3x3 matrix of numbers"),
        ("1 2 3", "is neither a focal length nor a 3x3 matrix of numbers"),
        ("-300", "a camera must have a size and finite, positive focal lengths"),
    ],
)
def test_bad_input_is_named_in_one_line(source, refused, text, says):
    (source / "train/calibration/frame_00003.txt").write_text(text)
    refused(read_capture, source, "frame_00003.txt", says)
