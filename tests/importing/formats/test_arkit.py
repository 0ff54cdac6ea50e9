"""Record3D and Polycam: ARKit's axes turned to OpenCV's, every damage named in one line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from recorded import FRAMES, SIZE
from scipy.spatial.transform import Rotation

from mambaloc.importing.formats.arkit import read_polycam, read_record3d
from mambaloc.importing.registry import read_capture

WIDTH, HEIGHT = SIZE


def arkit(world_from_cam):
    """The same cameras in ARKit's axes: half a turn about x."""
    turned = world_from_cam.copy()
    turned[:, :3, :3] = (
        Rotation.from_matrix(turned[:, :3, :3]) * Rotation.from_euler("x", 180, degrees=True)
    ).as_matrix()
    return turned


def test_arkit_axes_are_what_apple_says(recording):
    """Looking along -z, y up: what is ahead and above in OpenCV's axes is (0, -1, 1)."""
    for cv, ar in zip(recording.world_from_cam, arkit(recording.world_from_cam), strict=True):
        np.testing.assert_allclose(cv[:3, :3] @ [0, -1, 1], ar[:3, :3] @ [0, 1, -1], atol=1e-12)


@pytest.fixture
def metadata(recording) -> dict:
    turned = arkit(recording.world_from_cam)
    xyzw = Rotation.from_matrix(turned[:, :3, :3]).as_quat()
    return {
        "h": HEIGHT,
        "w": WIDTH,
        "K": [58.0, 0, 0, 0, 59.0, 0, 33.0, 25.0, 1],
        "fps": 60,
        "poses": np.column_stack([xyzw, turned[:, :3, 3]]).tolist(),
    }


@pytest.fixture
def record3d(recording, metadata, tmp_path):
    recording.write(tmp_path / "rgbd", [f"{k}.jpg" for k in range(FRAMES)])
    (tmp_path / "metadata").write_text(json.dumps(metadata))
    return tmp_path


@pytest.mark.parametrize("names", ["{}.jpg", "{:07d}.png"])
def test_a_record3d_recording_is_read_back(recording, metadata, tmp_path, names):
    folder, file = ("rgbd", "metadata") if "jpg" in names else ("rgb", "metadata.json")
    recording.write(tmp_path / folder, [names.format(k) for k in range(FRAMES)])
    (tmp_path / file).write_text(json.dumps(metadata))
    capture = read_capture(tmp_path)
    assert (capture.kind, capture.unit, capture.time_s) == ("record3d", "metre", None)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-12)
    assert [path.read_bytes() for path in capture.images] == recording.jpegs
    (camera,) = capture.cameras.values()
    assert capture.camera_of == tuple(capture.cameras) * FRAMES
    assert (camera.width, camera.height, camera.focal_px, camera.center_px) == (*SIZE, (58, 59), (32.5, 24.5))


def test_the_lens_of_each_frame_and_its_time(record3d, metadata):
    lenses = [[58.0 + (k > 2), 59.0, 33.0, 25.0] for k in range(FRAMES)]
    stamps = [5.0 + k / 60 for k in range(FRAMES)]
    (record3d / "metadata").write_text(
        json.dumps({**metadata, "perFrameIntrinsicCoeffs": lenses, "frameTimestamps": stamps})
    )
    capture = read_record3d(record3d)
    assert capture.time_s.tolist() == stamps
    assert [capture.cameras[name].focal_px[0] for name in capture.camera_of] == [58, 58, 58, 59, 59, 59]
    assert len(capture.cameras) == 2


def test_record3d_frames_are_found_by_their_number(record3d, recording):
    (record3d / "rgbd" / "1.jpg").unlink()
    (record3d / "rgbd" / "5.jpg").rename(record3d / "rgbd" / "60.jpg")
    capture = read_record3d(record3d)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam[[0, 2, 3, 4]], atol=1e-12)
    assert capture.poses_without_image == ("rgbd/1.jpg", "rgbd/5.jpg")
    assert capture.images_without_pose == (record3d / "rgbd" / "60.jpg",)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"poses": None}, "'poses' must be N x 7 finite numbers"),
        ({"poses": []}, "'poses' must be N x 7 finite numbers"),
        ({"poses": [[0, 0, 0, 1, 0, 0]]}, "'poses' must be N x 7 finite numbers"),
        ({"poses": [[0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0]]}, "'poses' must be N x 7 finite numbers"),
        ({"poses": [[0, 0, 0, 1, 0, 0, 10**400]]}, "'poses' must be N x 7 finite numbers"),
        ({"poses": [[0, 0, 0, 1, 0, 0, "far"]]}, "'poses' must be N x 7 finite numbers"),
        ({"poses": {"0": 1}}, "'poses' must be N x 7 finite numbers"),
        ({"poses": [[0, 0, 0, 1, 0, 0, 0]] * 6}, "all 6 poses are the same; record with the LiDAR camera"),
        ({"poses": [[0, 0, 0, 9, 2, 0, 0], [0, 0, 0, 0.1, 1, 0, 0]]}, "poses, row 0: the quaternion is far from unit"),
        ({"K": [1, 2]}, "'K' must be 9 finite numbers"),
        ({"K": [0] * 9}, "must have a size and finite, positive focal lengths"),
        ({"K": [58.0, 0, 33.0, 0, 59.0, 25.0, 0, 0, 1]}, "principal point -0, -0 is far from the centre"),  # row-major
        ({"w": 0}, "must have a size"),
        ({"w": 64.5}, "must have a size"),
        ({"w": 1e30}, "must have a size"),
        ({"w": 32767}, "at most 32766 pixels a side"),
        ({"h": None}, "'w, h' must be 2 finite numbers"),
        ({"perFrameIntrinsicCoeffs": [[1, 2, 3, 4]]}, "'perFrameIntrinsicCoeffs' must be 6 x 4 finite numbers"),
        ({"frameTimestamps": [1.0]}, "'frameTimestamps' must be 6 finite numbers"),
    ],
)
def test_record3d_damage_is_named_in_one_line(record3d, metadata, refused, change, says):
    (record3d / "metadata").write_text(json.dumps({**metadata, **change}))
    refused(read_record3d, record3d, says, str(record3d / "metadata"))


def test_what_is_no_recording(record3d, refused, tmp_path):
    whole = (record3d / "metadata").read_text()
    for content in (whole[: len(whole) // 2], "[]", "", "[" * 100_000):
        (record3d / "metadata").write_text(content)
        rule = "metadata: is not a JSON object" if content == "[]" else "metadata: is not JSON"
        refused(read_record3d, record3d, rule)
    (record3d / "metadata").unlink()
    refused(read_record3d, record3d, "metadata.json: cannot be read")
    (tmp_path / "a.r3d").write_bytes(b"PK")
    refused(read_capture, tmp_path / "a.r3d", "is an archive; unpack it")


# --- Polycam ---------------------------------------------------------------------------------------------------------


def keyframe(matrix, **change) -> str:
    frame = {f"t_{i}{j}": matrix[i, j] for i in range(3) for j in range(4)}
    frame |= {"fx": 58.0, "fy": 58.0, "cx": 33.0, "cy": 25.0, "width": WIDTH, "height": HEIGHT, "blur_score": 90.0}
    return json.dumps({**frame, **change})


STAMPS = [123_456_789 + 250_000 * k for k in range(FRAMES)]


@pytest.fixture
def polycam(recording, tmp_path):
    """Images and ARKit's poses, 10 cm off; optimised ones for all."""
    for prefix, off in (("", 0.1), ("corrected_", 0.0)):
        recording.write(tmp_path / "keyframes" / f"{prefix}images", [f"{stamp}.jpg" for stamp in STAMPS])
        cameras = tmp_path / "keyframes" / f"{prefix}cameras"
        cameras.mkdir()
        for stamp, pose in zip(STAMPS, arkit(recording.world_from_cam), strict=True):
            moved = pose.copy()
            moved[0, 3] += off
            (cameras / f"{stamp}.json").write_text(keyframe(moved))
    return tmp_path


@pytest.mark.parametrize("place", [".", "keyframes"])
def test_optimised_polycam_poses_are_preferred(polycam, recording, place):
    capture = read_capture(polycam / place)
    assert (capture.kind, capture.unit) == ("polycam", "metre")
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-12)
    np.testing.assert_allclose(capture.time_s, np.array(STAMPS) / 1e6)
    assert {path.parent.name for path in capture.images} == {"corrected_images"}
    assert capture.choices["poses"] == "6 optimised by the app"
    (camera,) = capture.cameras.values()
    assert (camera.focal_px, camera.center_px) == ((58, 58), (32.5, 24.5))


def test_which_polycam_poses_were_taken_is_stated(polycam, recording):
    (polycam / "keyframes/corrected_cameras" / f"{STAMPS[3]}.json").unlink()
    capture = read_polycam(polycam)
    assert capture.choices["poses"] == "5 optimised by the app; not read: 1 that it did not optimise"
    np.testing.assert_allclose(capture.world_from_cam, np.delete(recording.world_from_cam, 3, axis=0), atol=1e-12)
    (polycam / "keyframes/corrected_images").rename(polycam / "hidden")
    capture = read_polycam(polycam)
    assert "corrected_images, which are missing" in capture.choices["poses"]
    np.testing.assert_allclose(capture.world_from_cam[:, 0, 3], recording.position_m[:, 0] + 0.1)


def test_arkit_poses_are_taken_where_none_were_optimised(polycam, recording):
    for name in ("corrected_images", "corrected_cameras"):
        (polycam / "keyframes" / name).rename(polycam / name.replace("corrected", "hidden"))
    (polycam / "keyframes" / "images" / f"{STAMPS[0]}.jpg").unlink()
    (polycam / "keyframes" / "cameras" / f"{STAMPS[5]}.json").unlink()
    capture = read_polycam(polycam)
    np.testing.assert_allclose(capture.world_from_cam[:, 0, 3], recording.position_m[1:5, 0] + 0.1)
    assert "ARKit's own" in capture.choices["poses"]
    assert capture.poses_without_image == (f"images/{STAMPS[0]}.jpg",)
    assert capture.images_without_pose == (polycam / "keyframes" / "images" / f"{STAMPS[5]}.jpg",)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"t_00": None}, "'t_00 to t_23' must be 12 finite numbers"),
        ({"t_23": float("inf")}, "'t_00 to t_23' must be 12 finite numbers"),
        ({"fx": 0}, "must have a size and finite, positive focal"),
        ({"cx": "wide"}, "'fx, fy, cx, cy' must be 4 finite numbers"),
        ({"width": -5}, "must have a size"),
        ({"cx": 1000}, "is far from the centre"),
    ],
)
def test_polycam_damage_is_named_in_one_line(polycam, recording, refused, change, says):
    damaged = polycam / "keyframes" / "corrected_cameras" / f"{STAMPS[2]}.json"
    damaged.write_text(keyframe(arkit(recording.world_from_cam)[2], **change))
    refused(read_polycam, polycam, says, str(damaged))
    damaged.write_text(damaged.read_text()[:30])
    refused(read_polycam, polycam, "is not JSON", str(damaged))


def test_a_polycam_matrix_that_is_no_rotation_is_left_out_by_name(polycam, recording):
    whole = read_polycam(polycam)
    file = polycam / "keyframes" / "corrected_cameras" / f"{STAMPS[2]}.json"
    file.write_text(keyframe(arkit(recording.world_from_cam)[2], t_00=2))
    capture = read_polycam(polycam)
    kept = [row for row, image in enumerate(whole.images) if image.stem != str(STAMPS[2])]
    np.testing.assert_allclose(capture.world_from_cam, whole.world_from_cam[kept])
    ((name, rule),) = capture.left_out.items()
    assert name.endswith(f"{STAMPS[2]}.jpg")
    assert rule == f"the pose's rotation is not orthonormal ({file})"


def test_a_polycam_folder_without_cameras(polycam, refused):
    for path in (polycam / "keyframes" / "corrected_cameras").iterdir():
        path.unlink()
    refused(read_polycam, polycam, "has no keyframes/cameras/STAMP.json")
