"""KITTI odometry and bare pose files: the colour camera beside the grey one, every damage named in one line."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from recorded import FRAMES, SIZE

from mambaloc.importing.formats.kitti import read_kitti, read_kitti_poses
from mambaloc.importing.registry import read_capture
from mambaloc.rendering import default_intrinsics

CAM2_FROM_CAM0_M = np.array([0.0607, -0.0004, 0.0027])
"""About KITTI's own: where camera 0's centre is, seen from camera 2."""


def rows(matrices) -> str:
    return "".join(" ".join(f"{n:.9e}" for n in matrix[:3].ravel()) + "\n" for matrix in matrices)


def calibration() -> str:
    matrix = default_intrinsics(SIZE)
    projections = {"P0": np.zeros(3), "P1": np.zeros(3), "P2": CAM2_FROM_CAM0_M, "P3": np.zeros(3)}
    lines = {name: np.column_stack([matrix, matrix @ moved]) for name, moved in projections.items()}
    return "".join(f"{name}: {' '.join(f'{n:.12e}' for n in p.ravel())}\n" for name, p in lines.items()) + "Tr: 1 0 0\n"


@pytest.fixture
def kitti(recording, tmp_path):
    """One sequence whose camera 2 is the recording's."""
    cam2_from_cam0 = np.eye(4)
    cam2_from_cam0[:3, 3] = CAM2_FROM_CAM0_M
    sequence = tmp_path / "sequences" / "07"
    recording.write(sequence / "image_2", [f"{k:06d}.png" for k in range(FRAMES)])
    (sequence / "calib.txt").write_text(calibration())
    (sequence / "times.txt").write_text("".join(f"{k / 10:e}\n" for k in range(FRAMES)))
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "07.txt").write_text(rows(recording.world_from_cam @ cam2_from_cam0))
    return tmp_path


@pytest.mark.parametrize("place", [".", "sequences/07"])
def test_a_sequence_is_read_back(kitti, recording, place):
    capture = read_capture(kitti / place)
    assert (capture.kind, capture.unit) == ("kitti", "metre")
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-8)
    np.testing.assert_allclose(capture.time_s, np.arange(FRAMES) / 10)
    assert [path.read_bytes() for path in capture.images] == recording.jpegs
    assert set(capture.sequences) == {"07"}
    assert set(capture.camera_of) == {"image_2"}
    camera = capture.cameras["image_2"]
    assert (camera.width, camera.height, camera.distorted) == (*SIZE, None)
    np.testing.assert_allclose(
        (*camera.focal_px, *camera.center_px), default_intrinsics(SIZE)[[0, 1, 0, 1], [0, 1, 2, 2]]
    )


def test_a_world_point_falls_where_the_calibration_projects_it(kitti):
    """P2 takes a point of camera 0 to image 2; so must the pose that is read, with the camera that is read."""
    capture = read_kitti(kitti)
    world_from_cam0 = np.array([float(n) for n in (kitti / "poses/07.txt").read_text().split()]).reshape(-1, 3, 4)
    words = (kitti / "sequences/07/calib.txt").read_text().splitlines()[2].split()[1:]
    projection = np.array(words, dtype=float).reshape(3, 4)
    camera = capture.cameras["image_2"]
    matrix = np.array(
        [[camera.focal_px[0], 0, camera.center_px[0]], [0, camera.focal_px[1], camera.center_px[1]], [0, 0, 1]]
    )
    for pose0, pose in zip(world_from_cam0, capture.world_from_cam, strict=True):
        point_cam0 = np.array([0.3, -0.2, 2.0])
        world = pose0[:, :3] @ point_cam0 + pose0[:, 3]
        expected = projection @ [*point_cam0, 1]
        cam_from_world = np.linalg.inv(pose)
        turn = cv2.Rodrigues(cam_from_world[:3, :3])[0]
        pixel = cv2.projectPoints(world[None], turn, cam_from_world[:3, 3], matrix, None)[0][0, 0]
        np.testing.assert_allclose(pixel, expected[:2] / expected[2], atol=1e-6)


def test_the_grey_camera_is_where_the_poses_are(kitti):
    sequence = kitti / "sequences" / "07"
    (sequence / "image_2").rename(sequence / "image_0")
    capture = read_kitti(kitti)
    expected = np.array([float(n) for n in (kitti / "poses/07.txt").read_text().split()]).reshape(-1, 3, 4)
    np.testing.assert_allclose(capture.world_from_cam[:, :3], expected, atol=1e-8)
    assert set(capture.cameras) == {"image_0"}


def test_images_are_found_by_their_number(kitti, recording):
    images = sorted((kitti / "sequences/07/image_2").iterdir())
    images[1].unlink()
    images[5].rename(images[5].with_name("000017.png"))
    (kitti / "sequences/07/times.txt").unlink()
    capture = read_kitti(kitti)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam[[0, 2, 3, 4]], atol=1e-8)
    assert capture.poses_without_image == ("image_2/000001.png", "image_2/000005.png")
    assert [path.name for path in capture.images_without_pose] == ["000017.png"]
    assert capture.time_s is None


def test_several_sequences_are_several_worlds(kitti, refused):
    (kitti / "sequences" / "08").mkdir()
    (kitti / "poses" / "08.txt").touch()
    refused(read_capture, kitti, "the sequences 07, 08, each with a world of its own", "sequences/07")
    assert read_capture(kitti / "sequences" / "07").kind == "kitti"


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("poses/07.txt", "1 0 0 0 0 1 0 0 0 0 1\n", "07.txt, line 1: is not a line"),
        ("poses/07.txt", "1 0 0 0 0 2 0 0 0 0 1 0\n", "07.txt, line 1: the pose's rotation is not orthonormal"),
        ("poses/07.txt", "1 0 0 0 0 1 0 0 0 0 -1 0\n", "07.txt, line 1: the pose's rotation is not orthonormal"),
        ("poses/07.txt", "", "07.txt: is empty"),
        ("poses/07.txt", None, "has no NN.txt of a folder"),
        ("sequences/07/calib.txt", None, "calib.txt: missing"),
        ("sequences/07/calib.txt", "P0: 1 2 3\n", "calib.txt: has no line 'P2:' of 12 finite numbers"),
        ("sequences/07/calib.txt", "P2: 1 2 3\n", "calib.txt: has no line 'P2:' of 12 finite numbers"),
        ("sequences/07/calib.txt", f"P2: {'1 ' * 12}\n", "is not a projection K [I | t]"),
        (
            "sequences/07/calib.txt",
            "P2: 9 0 600 0 0 9 24 0 0 0 1 0\n",
            "principal point 600, 24 is far from the centre",
        ),
        ("sequences/07/calib.txt", "P2: 9 0 32 900 0 9 24 0 0 0 1 0\n", "is more than 10 m from camera 0"),
        ("sequences/07/calib.txt", "P2: 1e-300 0 32 1e300 0 9 24 0 0 0 1 0\n", "is more than 10 m from camera 0"),
        ("sequences/07/calib.txt", "P2: inf 0 32 0 0 9 24 0 0 0 1 0\n", "has no line 'P2:' of 12 finite numbers"),
        ("sequences/07/times.txt", "0\n1\n", "times.txt: has 2 times for 6 poses"),
        ("sequences/07/times.txt", "0\n1 2\n", "times.txt, line 2: is not a line 'seconds'"),
        ("sequences/07/image_2/000000.png", "no image", "000000.png: image cannot be decoded"),
    ],
)
def test_damage_is_named_in_one_line(kitti, refused, file, content, says):
    (kitti / file).unlink()
    if content is not None:
        (kitti / file).write_text(content)
    refused(read_kitti, kitti, says, str(kitti))


# --- bare pose files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["poses.txt", "run.kitti"])
def test_a_bare_file_is_read_in_the_order_of_names(recording, tmp_path, name):
    images = recording.write(tmp_path / "images", [f"a{k}.jpg" for k in (2, 9, 10, 11, 100, 1000)])
    (tmp_path / name).write_text(rows(recording.world_from_cam))
    for source in (tmp_path, tmp_path / name):
        capture = read_capture(source)
        assert (capture.kind, capture.unit, capture.images) == ("kitti_poses", "unknown", tuple(images))
        np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-8)


def test_another_number_of_images_is_refused(recording, tmp_path, refused):
    recording.write(tmp_path, [f"{k}.jpg" for k in range(FRAMES)])
    (tmp_path / "poses.txt").write_text(rows(recording.world_from_cam[:-1]))
    refused(read_kitti_poses, tmp_path, "has 5 poses, and", "6 images; give as many")


def test_two_bare_files_are_ambiguous(recording, tmp_path, refused):
    recording.write(tmp_path, [f"{k}.jpg" for k in range(FRAMES)])
    for name in ("poses.txt", "b.kitti"):
        (tmp_path / name).write_text(rows(recording.world_from_cam))
    refused(read_kitti_poses, tmp_path, "holds poses.txt and b.kitti")
