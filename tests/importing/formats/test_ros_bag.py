"""ROS bags: poses against SciPy in each kind of bag and each kind of pose, lenses against OpenCV, damage named."""

from __future__ import annotations

import builtins
import sys
import warnings
import weakref

import cv2
import numpy as np
import pytest
from bag_writing import FIRST_NS, KINDS, png, recording_in
from captures import tool
from scipy.spatial.transform import Rotation, Slerp

from mambaloc.errors import InputError, InputWarning
from mambaloc.importing.formats import ros_bag
from mambaloc.importing.formats.ros_bag import BagTopics, read_ros_bag
from mambaloc.importing.registry import FORMATS, read_capture
from mambaloc.rendering import default_intrinsics, furnished_room, render, smooth_trajectory

SIZE, FRAMES = (160, 120), 14
STEP_NS = 100_000_000
INSIDE_M = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))
CAM = "camera_optical"
K = default_intrinsics(SIZE)
BASE_FROM_CAM = np.eye(4)
BASE_FROM_CAM[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # REP 103: x forward, z up; z forward, y down
BASE_FROM_CAM[:3, 3] = 0.3, 0.02, 0.5


@pytest.fixture(scope="module")
def drive():
    """Times of images, between those of poses; of the base at those; of the camera by SciPy; images there."""
    pose_ns = FIRST_NS + STEP_NS // 2 * np.arange(2 * FRAMES + 2)
    base = smooth_trajectory(len(pose_ns), seed=5, inside_m=INSIDE_M, step_deg=3.0) @ np.linalg.inv(BASE_FROM_CAM)
    taken_ns = FIRST_NS + STEP_NS * np.arange(FRAMES) + 11_000_000
    since, when = (pose_ns - FIRST_NS) / 1e9, (taken_ns - FIRST_NS) / 1e9
    of_base = np.tile(np.eye(4), (FRAMES, 1, 1))
    of_base[:, :3, :3] = Slerp(since, Rotation.from_matrix(base[:, :3, :3]))(when).as_matrix()
    of_base[:, :3, 3] = np.stack([np.interp(when, since, base[:, axis, 3]) for axis in range(3)], axis=1)
    of_camera = of_base @ BASE_FROM_CAM
    room = furnished_room(INSIDE_M, seed=0, px_per_m=70)
    return pose_ns, base, taken_ns, of_camera, [render(room, K, pose, SIZE)[0] for pose in of_camera]


def write_pictures(bag, drive, topic="/eye/image_raw", **camera):
    for ns, rgb in zip(drive[2].tolist(), drive[4], strict=True):
        bag.image(topic, ns, CAM, rgb)
    bag.camera("/eye/camera_info", FIRST_NS, CAM, SIZE, K, **camera)


def write_poses(bag, drive, how="odometry"):
    for ns, pose in zip(drive[0].tolist(), drive[1], strict=True):
        if how == "odometry":
            bag.odometry("/odom", ns, "odom", "base_link", pose)
        elif how == "tf":
            bag.transform(ns, "odom", "base_link", pose)
        else:
            bag.pose_stamped("/pose", ns, "odom", pose)
    bag.transform(0, "base_link", CAM, BASE_FROM_CAM, "/tf_static")


@pytest.fixture
def record(tmp_path, monkeypatch):
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path / "cache"))

    return recording_in(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", ["odometry", "tf", "pose"])
def test_poses_are_those_of_the_optical_frame_at_the_pictures_times(record, drive, kind, how):
    path = record(lambda bag: (write_pictures(bag, drive), write_poses(bag, drive, how)), kind)
    asked = BagTopics(pose_frame="base_link") if how == "pose" else None
    capture = read_capture(path, topics=asked)
    assert (capture.kind, capture.unit, set(capture.sequences)) == ("ros_bag", "metre", {"drive"})
    numbers = [int(image.stem) for image in capture.images]
    assert len(numbers) > FRAMES // 2
    np.testing.assert_allclose(capture.world_from_cam, drive[3][numbers], atol=1e-9)
    np.testing.assert_allclose(capture.time_s, drive[2][numbers] / 1e9, atol=1e-6)
    for number, image in zip(numbers, capture.images, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(image), cv2.IMREAD_COLOR_RGB), drive[4][number])
    (camera,) = capture.cameras.values()
    assert (camera.width, camera.height, camera.distorted) == (*SIZE, None)
    assert camera.focal_px == pytest.approx((K[0, 0], K[1, 1]))
    assert camera.center_px == pytest.approx((K[0, 2], K[1, 2]))
    assert "odom -> base_link -> camera_optical" in capture.choices["direction"]
    assert "gaps" not in capture.choices


def test_files_of_compressed_pictures_are_kept_as_they_are(record, drive):
    files = [cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes() for rgb in drive[4]]
    files[3], files[5] = png(drive[4][3]), files[5][:-30]

    def write(bag):
        for ns, file in zip(drive[2].tolist(), files, strict=True):
            bag.compressed("/eye/image_raw/compressed", ns, CAM, file)
        write_poses(bag, drive)

    capture = read_capture(record(write))
    for image in capture.images:
        assert image.read_bytes() == files[int(image.stem)]
        assert image.suffix == (".png" if image.stem == "000003" else ".jpg")
    assert capture.left_out == {"/eye/image_raw/compressed, message 5": "image is truncated"}
    assert not capture.cameras


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("plumb_bob", (-0.2, 0.05, 0.001, -0.002, 0.01)),
        ("rational_polynomial", (0.3, 0.02, 0.001, -0.002, 0.01, 0.5, 0.03, 0.01)),
        ("equidistant", (0.05, -0.01, 0.002, 0.0)),
    ],
)
def test_lenses_are_opencvs(record, drive, model, coefficients):
    path = record(
        lambda bag: (write_pictures(bag, drive, distortion_model=model, d=coefficients), write_poses(bag, drive))
    )
    (camera,) = read_capture(path).cameras.values()
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2))
    points = np.column_stack((rays, np.ones(20)))[:, None]
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    still = np.zeros((3, 1))
    pixels = project(points, still, still, K, np.array(coefficients))[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.distorted(rays), pixels, atol=1e-6)
    assert camera.model == model


def test_gaps_are_told_and_their_pictures_left_out(record, drive):
    """Poses pause for 0.7 s, and end before the last image."""
    kept = [row for row in range(len(drive[0])) if not 8 < row < 22 and row < 27]

    def write(bag):
        write_pictures(bag, drive)
        write_poses(bag, (drive[0][kept], drive[1][kept]))

    path = record(write)
    with pytest.warns(InputWarning, match=r"drive: 8 images have no pose: 7 in gaps of odom -> base_link over 0.5 s"):
        capture = read_capture(path)
    numbers = {int(image.stem) for image in capture.images}
    assert not numbers & {4, 5, 6, 7, 8, 9, 10, 13}
    assert numbers & {0, 1, 2, 3}
    assert numbers & {11, 12}
    said = capture.choices["gaps"]
    assert "the longest of 0.70 s around" in said
    assert "1 before the first or after the last of odom -> base_link" in said


def test_pictures_are_held_one_by_one(record, drive, monkeypatch):
    alive: list[weakref.ref] = []
    most = 0
    images_of = ros_bag.images_of

    def watched(bag, topic):
        nonlocal most
        for picture in images_of(bag, topic):
            alive.append(weakref.ref(picture))
            most = max(most, sum(ref() is not None for ref in alive))
            yield picture

    monkeypatch.setattr(ros_bag, "images_of", watched)
    read_ros_bag(record(lambda bag: (write_pictures(bag, drive), write_poses(bag, drive))))
    assert len(alive) == FRAMES
    assert most <= 4


def two_of_each(bag, drive):
    write_pictures(bag, drive)
    write_poses(bag, drive)
    write_poses(bag, drive, "tf")


def islands(bag, drive):
    write_pictures(bag, drive)
    bag.odometry("/odom", FIRST_NS, "odom", "base_link", np.eye(4))
    bag.transform(0, "mast", CAM, np.eye(4), "/tf_static")


@pytest.mark.parametrize(
    ("write", "asked", "says"),
    [
        (two_of_each, None, "has poses in /odom, /tf. Choose one with --pose-topic NAME"),
        (two_of_each, BagTopics(poses="/up"), "--pose-topic /up: the bag has no poses there"),
        (two_of_each, BagTopics(images="/up"), "--topic /up"),
        (islands, None, "no transform links the frames 'base_link' and 'camera_optical'"),
        (write_pictures, None, "nothing says where the camera 'camera_optical' was"),
        (lambda bag, drive: (write_pictures(bag, drive), write_poses(bag, drive, "pose")), None, "--pose-frame"),
        (lambda bag, drive: write_poses(bag, drive), None, "has no topic of images"),
        (
            lambda bag, drive: (
                write_pictures(bag, drive, distortion_model="thin_prism", d=[0.1] * 5),
                write_poses(bag, drive),
            ),
            None,
            "CameraInfo of /eye/image_raw: has the distortion model 'thin_prism' with 5 coefficients",
        ),
        (
            lambda bag, drive: (write_pictures(bag, drive), write_poses(bag, (drive[0] - 10**12, drive[1]))),
            None,
            "no image of /eye/image_raw has a pose; 14 images have no pose: 14 before the first or after the last",
        ),
    ],
)
def test_what_does_not_say_where_it_was_is_refused(record, drive, refused, write, asked, says):
    refused(lambda source: read_ros_bag(source, asked), record(lambda bag: write(bag, drive)), says)


def test_the_source_of_poses_can_be_chosen(record, drive):
    path = record(lambda bag: two_of_each(bag, drive))
    for name in ("/odom", "/tf"):
        capture = read_ros_bag(path, BagTopics(poses=name))
        assert capture.choices["direction"].endswith(f"by {name}")


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_bag_is_refused_in_a_line(record, drive, refused, kind):
    path = record(lambda bag: (write_pictures(bag, drive), write_poses(bag, drive)), kind)
    file = path if path.is_file() else next(each for each in path.iterdir() if each.suffix != ".yaml")
    whole = file.read_bytes()
    for data in (b"", whole[:50], whole[: len(whole) // 2], whole[: -len(whole) // 4]):
        file.write_bytes(data)
        refused(read_ros_bag, path, "drive", "cannot be read")


@pytest.mark.parametrize("kind", KINDS)
def test_random_damage_is_read_or_refused_in_a_line(record, drive, kind):
    small = [np.ascontiguousarray(rgb[::20, ::20]) for rgb in drive[4]]
    path = record(lambda bag: (write_pictures(bag, (*drive[:4], small)), write_poses(bag, drive, "tf")), kind)
    file = path if path.is_file() else next(each for each in path.iterdir() if each.suffix != ".yaml")
    rng, whole = np.random.default_rng(0), file.read_bytes()
    for _ in range(10):
        data = bytearray(whole)
        for start in rng.integers(0, len(whole), 3).tolist():
            data[start : start + 8] = rng.choice([0, 127, 255], 8).astype(np.uint8).tobytes()
        file.write_bytes(data)
        with warnings.catch_warnings(action="ignore"):
            try:
                read = [image.is_file() for image in read_ros_bag(path).images]
            except InputError as error:
                read = ["\n" not in str(error)]
        assert all(read)


def test_without_rosbags_the_extra_is_named(record, drive, refused, monkeypatch):
    path = record(lambda bag: write_pictures(bag, drive))
    for name in [name for name in sys.modules if name.partition(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    imported = builtins.__import__

    def without(name, *more):
        if name.startswith("rosbags"):
            raise ImportError(name)
        return imported(name, *more)

    monkeypatch.setattr(builtins, "__import__", without)
    assert FORMATS["ros_bag"].matches(path)
    refused(read_capture, path, "a ROS bag needs rosbags. Run pip install 'mambaloc[ros]'.")


def test_topics_are_of_bags_alone(tmp_path, capsys):
    (tmp_path / "a.jpg").touch()
    with pytest.raises(SystemExit) as ended:
        tool(tmp_path, "--out", tmp_path / "scene", "--topic", "/eye")
    assert ended.value.code == 2
    assert "is not a ROS bag but structure_from_motion" in capsys.readouterr().err
