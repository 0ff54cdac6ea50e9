"""kapture: poses and rigs against SciPy and kapture itself, lenses against OpenCV, and every bad input named.

Guesses, made before they were looked up: poses of trajectories are world-to-device, those of rigs rig-to-sensor, and
principal points count from the image's corner, as COLMAP's (all right).
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.importing.registry import read_capture

VERSION = "# kapture format: 1.1\n"
FIRST = 1403636579763
LEFT_FROM_RIG, RIG_FROM_BASE = np.eye(4), np.eye(4)
LEFT_FROM_RIG[:3] = np.c_[Rotation.from_rotvec([0.1, 0.4, -0.2]).as_matrix(), [0.3, 0.0, -0.1]]
RIG_FROM_BASE[:3] = np.c_[Rotation.from_rotvec([-0.5, 0.1, 0.3]).as_matrix(), [0.0, 1.5, 0.2]]


def numbers(pose) -> str:
    """A transform as kapture has it: qw, qx, qy, qz, tx, ty, tz."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return ", ".join(map(repr, map(float, (w, x, y, z, *pose[:3, 3]))))


def write_part(folder, walk, rows, device_from_world, camera=None, device="cam0", stamps=None, names=None):
    """Write a kapture of some of the walk's images."""
    sensors = folder / "sensors"
    names = names or [f"left/{row:05d}.png" for row in rows]
    stamps = stamps or [str(FIRST + 100 * row) for row in rows]
    for row, name in zip(rows, names, strict=True):
        (sensors / "records_data" / name).parent.mkdir(parents=True, exist_ok=True)
        (sensors / "records_data" / name).write_bytes(walk.pngs[row])
    fx, fy, cx, cy = walk.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    camera = camera or f"PINHOLE, 320, 240, {fx!r}, {fy!r}, {cx + 0.5!r}, {cy + 0.5!r}"
    (sensors / "sensors.txt").write_text(f"{VERSION}# sensor_id, name, ...\ncam0, GoPro, camera, {camera}\nw, , wifi\n")
    records = [f"{stamp}, cam0, {name}" for stamp, name in zip(stamps, names, strict=True)]
    (sensors / "records_camera.txt").write_text(VERSION + "\n".join(records) + "\n")
    poses = [f"{stamp}, {device}, {numbers(device_from_world[row])}" for stamp, row in zip(stamps, rows, strict=True)]
    (sensors / "trajectories.txt").write_text(VERSION + "\n".join(poses) + "\n")
    return folder


@pytest.fixture
def cam_from_world(walk):
    return np.linalg.inv(walk.world_from_cam)


@pytest.fixture
def source(walk, cam_from_world, tmp_path):
    return write_part(tmp_path / "room", walk, range(12), cam_from_world)


def edit(path, change):
    path.write_text(change(path.read_text()))


def test_a_kapture_is_read_and_its_pictures_agree(source, walk):
    capture = read_capture(source)
    assert (capture.kind, capture.unit, set(capture.sequences)) == ("kapture", "unknown", {"left"})
    walk.is_agreed(capture)
    np.testing.assert_allclose(capture.time_s, FIRST / 1e3 + np.arange(12) / 10)
    assert capture.split is None


def test_a_dataset_of_mapping_and_query_is_a_split(walk, cam_from_world, tmp_path):
    write_part(tmp_path / "mapping", walk, range(8), cam_from_world)
    write_part(tmp_path / "query", walk, range(8, 12), cam_from_world)
    capture = read_capture(tmp_path)
    assert capture.split == ("train",) * 8 + ("test",) * 4
    np.testing.assert_allclose(capture.world_from_cam, walk.world_from_cam, atol=1e-6)
    assert len(capture.cameras) == 1
    write_part(tmp_path / "query", walk, [8, 9, 10, 11], cam_from_world, stamps=["7", "8", "9", "10"])
    write_part(tmp_path / "mapping", walk, range(8), cam_from_world, stamps=["0", "2", "4", "6", "1", "3", "5", "11"])
    assert read_capture(tmp_path).split == ("train",) * 7 + ("test",) * 4 + ("train",)  # in the order of one recording
    assert read_capture(tmp_path / "query").split == ("test",) * 4


def test_the_first_folder_of_a_path_is_a_split_too(walk, cam_from_world, tmp_path):
    names = [f"{'mapping' if row < 8 else 'query'}/cam/{row}.png" for row in range(12)]
    capture = read_capture(write_part(tmp_path, walk, range(12), cam_from_world, names=names))
    assert capture.split == ("train",) * 8 + ("test",) * 4


def rigged(walk, cam_from_world, folder):
    """The base of a rig on a rig is what has poses."""
    base_from_world = np.linalg.inv(LEFT_FROM_RIG @ RIG_FROM_BASE) @ cam_from_world
    write_part(folder, walk, range(12), base_from_world, device="base")
    rows = [f"rig, cam0, {numbers(LEFT_FROM_RIG)}", f"base, rig, {numbers(RIG_FROM_BASE)}"]
    (folder / "sensors/rigs.txt").write_text(VERSION + "\n".join(rows) + "\n")
    return folder


def test_a_sensor_of_a_rig_is_where_the_rig_says(walk, cam_from_world, tmp_path):
    capture = read_capture(rigged(walk, cam_from_world, tmp_path))
    np.testing.assert_allclose(capture.world_from_cam, walk.world_from_cam, atol=1e-6)


@pytest.mark.parametrize("is_rigged", [False, True])
def test_kapture_itself_reads_the_same(walk, cam_from_world, tmp_path, is_rigged):
    """Needs kapture (pip install kapture==1.1.12), which is not an extra of this project: it brings numba."""
    kapture = pytest.importorskip("kapture")
    csv = pytest.importorskip("kapture.io.csv")
    folder = tmp_path / "room"
    if is_rigged:
        rigged(walk, cam_from_world, folder)
    else:
        write_part(folder, walk, range(12), cam_from_world)
    data = csv.kapture_from_dir(str(folder))
    trajectories = kapture.rigs_remove(data.trajectories, data.rigs) if is_rigged else data.trajectories
    names = {name: (stamp, sensor) for stamp, sensor, name in kapture.flatten(data.records_camera)}
    capture = read_capture(folder)
    root = folder / "sensors/records_data"
    theirs = [trajectories[names[image.relative_to(root).as_posix()]].inverse() for image in capture.images]
    quaternions = np.array([pose.r_raw for pose in theirs])
    rotations = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(capture.world_from_cam[:, :3, :3], rotations, atol=1e-9)
    np.testing.assert_allclose(capture.world_from_cam[:, :3, 3], [pose.t_raw for pose in theirs], atol=1e-9)


@pytest.mark.parametrize(
    ("model", "values", "lens"),
    [
        ("SIMPLE_RADIAL", [0.1], (0.1, 0, 0, 0)),
        ("RADIAL", [0.1, 0.02], (0.1, 0.02, 0, 0)),
        ("OPENCV", [0.1, 0.02, 0.003, -0.004], (0.1, 0.02, 0.003, -0.004)),
        ("FULL_OPENCV", [0.1, 0.02, 0.003, -0.004, 0.01, 0.2, 0.05, 0.01], None),
        ("OPENCV_FISHEYE", [0.1, 0.02, 0.003, -0.004], (0.1, 0.02, 0.003, -0.004)),
        ("SIMPLE_RADIAL_FISHEYE", [0.1], (0.1, 0, 0, 0)),
        ("RADIAL_FISHEYE", [0.1, 0.02], (0.1, 0.02, 0, 0)),
        ("OPENCV_FISHEYE", [0.0] * 4, (0.0,) * 4),
    ],
)
def test_lenses_are_opencvs_and_colmaps(walk, cam_from_world, tmp_path, model, values, lens):
    pycolmap = pytest.importorskip("pycolmap")
    focal = [300.0] if "SIMPLE" in model or model.startswith("RADIAL") else [300.0, 310.0]
    told = [*focal, 165.0, 118.0, *values]
    camera = f"{model}, 320, 240, {', '.join(map(repr, told))}"
    (found,) = read_capture(write_part(tmp_path, walk, range(12), cam_from_world, camera)).cameras.values()
    rays = np.array([[0.4, -0.3], [-0.2, 0.1]])
    matrix = np.array([[focal[0], 0, 164.5], [0, focal[-1], 117.5], [0, 0, 1]])
    if model.endswith("FISHEYE"):
        expected = cv2.fisheye.distortPoints(rays[:, None], matrix, np.array(lens))[:, 0]
    else:
        points = np.c_[rays, np.ones(2)]
        expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(lens or values))[0][:, 0]
    np.testing.assert_allclose(found.distorted(rays), expected, atol=1e-9)
    colmap = pycolmap.Camera(model=model, width=320, height=240, params=told)
    np.testing.assert_allclose(found.distorted(rays), colmap.img_from_cam(np.c_[rays, np.ones(2)]) - 0.5, atol=1e-6)


def test_counters_are_no_times_and_pictures_come_in_their_order(walk, cam_from_world, tmp_path):
    stamps = [f"{row:04d}" for row in (3, 1, 2, 0, *range(4, 12))]
    capture = read_capture(write_part(tmp_path, walk, range(12), cam_from_world, stamps=stamps))
    assert capture.time_s is None
    assert [int(image.stem) for image in capture.images[:5]] == [3, 1, 2, 0, 4]


def test_poses_that_are_left_out_are_lost_frames(source):
    edit(source / "sensors/trajectories.txt", lambda text: text.replace(numbers_of(text, 3), ", , , , , , "))
    edit(source / "sensors/trajectories.txt", lambda text: "\n".join(text.splitlines()[:-1]) + "\n")
    capture = read_capture(source)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(capture.world_from_cam).any(axis=(1, 2))), [3])
    assert [image.name for image in capture.images_without_pose] == ["00011.png"]


def numbers_of(text, row) -> str:
    return text.splitlines()[1 + row].split(", ", 2)[2]


def test_a_camera_that_is_not_calibrated_is_none(walk, cam_from_world, tmp_path):
    capture = read_capture(write_part(tmp_path, walk, range(12), cam_from_world, "UNKNOWN_CAMERA, 320, 240"))
    assert (capture.cameras, capture.camera_of) == ({}, None)


BAD = [
    ("sensors.txt", "PINHOLE, 320", "FOV, 320", "camera model 'FOV' is not read, only SIMPLE_PINHOLE"),
    ("sensors.txt", "PINHOLE, 320", "OPENCV, 320", "sensors.txt, line 3: OPENCV must have 10 finite numbers"),
    ("sensors.txt", "PINHOLE, 320", "PINHOLE, 0", "sensors.txt, line 3: a camera must have a size"),
    ("sensors.txt", "cam0,", "cam9,", "records_camera.txt, line 2: sensor 'cam0' is not a camera of sensors.txt"),
    ("records_camera.txt", "left/00000.png", "../00000.png", "names '../00000.png', which is not a file inside"),
    ("records_camera.txt", ", cam0, left/00000.png", ", cam0", "line 2: is not a row timestamp, sensor, image"),
    ("records_camera.txt", f"{FIRST}, ", "noon, ", "line 2: time stamp 'noon' is not an integer"),
    ("trajectories.txt", f"{FIRST}, cam0, ", f"{FIRST}, cam0, x", "line 2: is not a quaternion and translation"),
]


@pytest.mark.parametrize(("file", "old", "new", "says"), BAD)
def test_bad_input_is_named_in_one_line(source, refused, file, old, new, says):
    edit(source / "sensors" / file, lambda text: text.replace(old, new, 1))
    refused(read_capture, source, says)


def test_rigs_that_carry_each_other_end(walk, cam_from_world, tmp_path, refused):
    write_part(tmp_path, walk, range(12), cam_from_world, device="nowhere")
    rows = [f"a, cam0, {numbers(np.eye(4))}", f"b, a, {numbers(np.eye(4))}", f"a, b, {numbers(np.eye(4))}"]
    (tmp_path / "sensors/rigs.txt").write_text("\n".join(rows))
    refused(read_capture, tmp_path, "has no image with a pose")
