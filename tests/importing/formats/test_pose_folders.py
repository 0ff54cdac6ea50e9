"""ScanNet and Replica as their tools lay them out: poses as written, lost ones counted, every damage in one line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from recorded import FRAMES, SIZE

from mambaloc.importing.formats.pose_folders import read_replica, read_scannet
from mambaloc.importing.registry import read_capture
from mambaloc.rendering import default_intrinsics

LOST = "-inf -inf -inf -inf\n" * 3 + "-inf -inf -inf -inf\n"


def text(matrix) -> str:
    """As ScanNet's reader writes it, six decimals."""
    return "".join(" ".join(f"{n:f}" for n in row) + "\n" for row in matrix)


@pytest.fixture
def scannet(recording, tmp_path):
    recording.write(tmp_path / "color", [f"{5 * k}.jpg" for k in range(FRAMES)])
    for folder in ("pose", "intrinsic"):
        (tmp_path / folder).mkdir()
    for k, pose in enumerate(recording.world_from_cam):
        (tmp_path / "pose" / f"{5 * k}.txt").write_text(text(pose))
    matrix = np.eye(4)
    matrix[:3, :3] = default_intrinsics(SIZE)
    (tmp_path / "intrinsic" / "intrinsic_color.txt").write_text(text(matrix))
    return tmp_path


@pytest.mark.parametrize("place", ["", "frames"])
def test_a_scannet_recording_is_read_back(scannet, recording, place, tmp_path_factory):
    source = scannet
    if place:
        source = tmp_path_factory.mktemp("scene0000_00")
        scannet.rename(source / place)
    capture = read_capture(source)
    assert (capture.kind, capture.unit, set(capture.camera_of)) == ("scannet", "metre", {"color"})
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=2e-6)
    turns = capture.world_from_cam[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-12)
    assert [path.read_bytes() for path in capture.images] == recording.jpegs  # 0, 5, 10, ..., not 0, 10, 15
    camera = capture.cameras["color"]
    assert (camera.width, camera.height) == SIZE
    np.testing.assert_allclose(
        (*camera.focal_px, *camera.center_px), default_intrinsics(SIZE)[[0, 1, 0, 1], [0, 1, 2, 2]]
    )


def test_lost_poses_are_left_out_and_counted(scannet, recording):
    (scannet / "pose" / "10.txt").write_text(LOST)
    (scannet / "pose" / "15.txt").write_text(text(np.full((4, 4), np.nan)))
    (scannet / "color" / "5.jpg").unlink()
    capture = read_scannet(scannet)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam[[0, 4, 5]], atol=2e-6)
    assert capture.choices["lost"] == "2 of 6 poses are infinite: left out"
    assert capture.images_without_pose == (scannet / "color" / "10.jpg", scannet / "color" / "15.jpg")
    assert capture.poses_without_image == ("color/5",)


def test_intrinsics_may_be_absent(scannet):
    (scannet / "intrinsic" / "intrinsic_color.txt").unlink()
    capture = read_scannet(scannet)
    assert (capture.cameras, capture.camera_of) == ({}, None)


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("pose/10.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n", "10.txt: is not the 16 numbers of a 4x4"),
        ("pose/10.txt", "one\n", "10.txt: is not the 16 numbers of a 4x4"),
        ("pose/10.txt", "", "10.txt: is not the 16 numbers of a 4x4"),
        ("intrinsic/intrinsic_color.txt", "1 2\n", "intrinsic_color.txt: is not the 16 numbers"),
        ("intrinsic/intrinsic_color.txt", text(np.eye(4)), "intrinsic_color.txt: principal point 0, 0 is far from"),
        ("intrinsic/intrinsic_color.txt", text(np.zeros((4, 4))), "must have a size and finite, positive focal"),
        ("intrinsic/intrinsic_color.txt", text(np.full((4, 4), np.nan)), "must have a size and finite, positive focal"),
    ],
)
def test_damage_is_named_in_one_line(scannet, refused, file, content, says):
    (scannet / file).write_text(content)
    refused(read_scannet, scannet, says, str(scannet))


@pytest.mark.parametrize(
    ("diagonal", "rule"),
    [([1.0, 1, 1.1, 1], "the pose's rotation is not orthonormal"), ([1.0, 1, 1, 2], "the pose's last row is not")],
)
def test_a_pose_that_is_none_is_left_out_by_name(scannet, diagonal, rule):
    whole = read_scannet(scannet)
    file = scannet / "pose" / f"{whole.images[1].stem}.txt"
    file.write_text(text(np.diag(diagonal)))
    capture = read_scannet(scannet)
    np.testing.assert_allclose(capture.world_from_cam, np.delete(whole.world_from_cam, 1, axis=0))
    assert list(capture.left_out) == [str(whole.images[1])]
    assert capture.left_out[str(whole.images[1])].startswith(rule)


def test_nothing_to_read(scannet, refused):
    for pose in (scannet / "pose").iterdir():
        pose.write_text(LOST)
    refused(read_scannet, scannet, "all 6 poses are infinite or NaN")
    for pose in (scannet / "pose").iterdir():
        pose.unlink()
    refused(read_scannet, scannet, "or no NAME.txt in")


# --- Replica ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def replica(recording, tmp_path):
    scene = tmp_path / "room0"
    recording.write(scene / "results", [f"frame{k:06d}.jpg" for k in range(FRAMES)])
    (scene / "results" / "depth000000.png").write_bytes(b"")
    lines = [" ".join(f"{n:.18e}" for n in pose.ravel()) for pose in recording.world_from_cam]
    (scene / "traj.txt").write_text("\n".join(lines) + "\n")
    width, height = SIZE
    lens = {"w": width, "h": height, "fx": 60.0, "fy": 61.0, "cx": 31.5, "cy": 23.5, "scale": 6553.5}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": lens}))
    return scene


def test_a_replica_scene_is_read_back(replica, recording):
    capture = read_capture(replica)
    assert (capture.kind, capture.unit, set(capture.camera_of)) == ("replica", "metre", {"frame"})
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-12)
    assert [path.read_bytes() for path in capture.images] == recording.jpegs
    camera = capture.cameras["frame"]
    assert (camera.width, camera.height, camera.focal_px, camera.center_px) == (*SIZE, (60, 61), (31.5, 23.5))
    assert not capture.images_without_pose  # depth is none


def test_replica_frames_are_found_by_their_number(replica, recording):
    (replica / "results" / "frame000002.jpg").unlink()
    (replica / "results" / "frame000005.jpg").rename(replica / "results" / "frame000009.jpg")
    (replica.parent / "cam_params.json").unlink()
    capture = read_replica(replica)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam[[0, 1, 3, 4]], atol=1e-12)
    assert capture.poses_without_image == ("results/frame000002", "results/frame000005")
    assert capture.images_without_pose == (replica / "results" / "frame000009.jpg",)
    assert capture.cameras == {}


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("traj.txt", "1 0 0\n", "traj.txt, line 1: is not a line"),
        ("traj.txt", "", "traj.txt: is empty"),
        (
            "traj.txt",
            "1 0 0 0 0 2 0 0 0 0 1 0 0 0 0 1\n1 0 0 0 0 3 0 0 0 0 1 0 0 0 0 1\n",
            "traj.txt, line 1: the pose's",
        ),
        ("../cam_params.json", "{", "cam_params.json: is not JSON"),
        ("../cam_params.json", "[1]", "cam_params.json: is not a JSON object"),
        ("../cam_params.json", "{}", "'camera: w h fx fy cx cy' must be 6 finite numbers"),
        ("../cam_params.json", '{"camera": {"w": 64, "h": 48}}', "must be 6 finite numbers"),
        (
            "../cam_params.json",
            '{"camera": {"w": 64, "h": 48, "fx": -1, "fy": 1, "cx": 31, "cy": 24}}',
            "must have a size and finite, positive focal",
        ),
    ],
)
def test_replica_damage_is_named_in_one_line(replica, refused, file, content, says):
    (replica / file).write_text(content)
    refused(read_replica, replica, says)
