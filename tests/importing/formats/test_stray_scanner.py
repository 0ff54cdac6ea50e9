"""Stray Scanner: a video, its poses in OpenCV's axes, and depth; every damage named in one line."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.importing.checks.depth import sampled
from mambaloc.importing.checks.explanations import AS_READ, by_convention
from mambaloc.importing.checks.matching import find_matches
from mambaloc.importing.formats.stray_scanner import read_stray_scanner
from mambaloc.importing.motion import motion_of
from mambaloc.importing.registry import read_capture
from mambaloc.importing.undistort.images import selected
from mambaloc.rendering import default_intrinsics, furnished_room, render, smooth_trajectory

SIZE, FRAMES = (320, 240), 40
INSIDE_M = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))
HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"
FIRST_S = 81234.5671


@pytest.fixture(scope="module")
def walk():
    """Poses, and what a camera sees there: images and depth in millimetres at a quarter of their size."""
    room, intrinsics = furnished_room(INSIDE_M, seed=0, px_per_m=140), default_intrinsics(SIZE)
    poses = smooth_trajectory(FRAMES, seed=5, inside_m=INSIDE_M, step_deg=2.0)
    seen = [render(room, intrinsics, pose, SIZE) for pose in poses]
    return poses, [rgb for rgb, _ in seen], [depth for _, depth in seen]


@pytest.fixture(scope="module")
def film(walk, tmp_path_factory):
    path = tmp_path_factory.mktemp("film") / "rgb.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30, SIZE)
    for rgb in walk[1]:
        writer.write(rgb[..., ::-1])
    writer.release()
    return path


def odometry(poses, header=HEADER, more="") -> str:
    """As the app writes it: rows of words between commas and spaces, scalar last."""
    xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = [
        ", ".join([f"{FIRST_S + k / 30:.6f}", f"{k:06d}", *(f"{n:.7f}" for n in (*pose[:3, 3], *turn))]) + more
        for k, (pose, turn) in enumerate(zip(poses, xyzw, strict=True))
    ]
    return "\n".join([header, *rows]) + "\n"


@pytest.fixture
def source(walk, film, tmp_path, monkeypatch):
    monkeypatch.setenv("MAMBALOC_CACHE", str(film.parent / "cache"))
    folder = tmp_path / "71de12f9"
    (folder / "depth").mkdir(parents=True)
    (folder / "rgb.mp4").symlink_to(film)
    (folder / "odometry.csv").write_text(odometry(walk[0]))
    fx, fy, cx, cy = default_intrinsics(SIZE)[[0, 1, 0, 1], [0, 1, 2, 2]]
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0.0, {cx + 0.5}\n0.0, {fy}, {cy + 0.5}\n0.0, 0.0, 1.0")
    (folder / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n")
    for number, depth in enumerate(walk[2]):
        small = cv2.resize(depth, (80, 60), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / f"depth/{number:06d}.png"), (1000 * small).round().astype(np.uint16))
    return folder


def test_a_recording_is_read_back(source, walk):
    capture = read_capture(source)
    numbers = [int(image.stem) for image in capture.images]
    assert (capture.kind, capture.unit, set(capture.sequences)) == ("stray_scanner", "metre", {"71de12f9"})
    assert numbers == sorted(numbers)
    assert 5 < len(numbers) < FRAMES  # chosen
    np.testing.assert_allclose(capture.world_from_cam, walk[0][numbers], atol=1e-6)
    np.testing.assert_allclose(capture.time_s, FIRST_S + np.array(numbers) / 30, atol=1e-6)
    (camera,) = capture.cameras.values()
    matrix = default_intrinsics(SIZE)
    assert camera.center_px == pytest.approx(tuple(matrix[:2, 2]))
    assert camera.focal_px == pytest.approx((matrix[0, 0], matrix[1, 1]))
    for number, image in zip(numbers, capture.images, strict=True):  # the frame of that number
        off = np.abs(cv2.imread(str(image), cv2.IMREAD_COLOR_RGB).astype(float) - walk[1][number])
        assert np.median(off) < 6
    assert capture.choices["frames"] == f"{len(numbers)} of {FRAMES}, by sharpness and movement"
    assert not capture.poses_without_image


def test_depth_is_that_of_the_frame_and_its_camera_sees_the_same(source, walk):
    """A depth pixel's ray, found by hand: depth pixel (u, v) covers frame pixels around 4 u + 1.5, 4 v + 1.5."""
    capture = read_capture(source)
    assert [file.stem for file in capture.depth.files] == [image.stem for image in capture.images]
    ray = np.linalg.inv(capture.depth.intrinsics) @ (10, 20, 1)
    np.testing.assert_allclose(default_intrinsics(SIZE) @ ray, (41.5, 81.5, 1), atol=1e-9)


def test_depth_of_low_confidence_is_left_out(source):
    """Guess: 0 is the lowest of three, as in ARKit; the format's page says the same."""
    assert read_capture(source).choices["depth"] == "all pixels"
    (source / "confidence").mkdir()
    sure = np.full((60, 80), 2, np.uint8)
    sure[:, :20], sure[:, 20:40] = 0, 1
    numbers = [int(image.stem) for image in read_capture(source).images]
    for number in numbers[1:]:  # the first has none: all of its depth counts
        cv2.imwrite(str(source / f"confidence/{number:06d}.png"), sure)
    capture, count = read_capture(source), len(numbers)
    said = f"pixels of confidence 0, of 0 to 2, are left out in {count - 1} of {count} frames"
    assert capture.choices["depth"] == said
    pixels = np.array([[10, 30], [19, 30], [20, 30], [60, 30]])
    rays = np.column_stack((pixels, np.ones(4))) @ np.linalg.inv(capture.depth.intrinsics)[:2].T
    for row in (0, 3):
        measured = cv2.imread(str(source / f"depth/{numbers[row]:06d}.png"), cv2.IMREAD_UNCHANGED)
        expected = measured[pixels[:, 1], pixels[:, 0]] / 1000
        expected[:2] = np.nan if row else expected[:2]
        np.testing.assert_allclose(sampled(capture.depth, row, rays), expected)
    np.testing.assert_array_equal(sampled(selected(capture, [3, 0]).depth, 0, rays), sampled(capture.depth, 3, rays))


@pytest.mark.parametrize("damage", ["cut", "size", "depth"])
def test_a_damaged_confidence_map_is_named(source, damage):
    number = int(read_capture(source).images[0].stem)
    (source / "confidence").mkdir()
    file = source / f"confidence/{number:06d}.png"
    shape, kind = ((50, 80) if damage == "size" else (60, 80)), np.uint16 if damage == "depth" else np.uint8
    cv2.imwrite(str(file), np.ones(shape, kind))
    if damage == "cut":
        file.write_bytes(file.read_bytes()[:-9])
    with pytest.raises(InputError, match=rf"confidence/{number:06d}\.png: is not a complete 8-bit PNG") as caught:
        sampled(read_capture(source).depth, 0, np.zeros((1, 2)))
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_matches_agree_with_the_axes_that_the_app_writes(source):
    """Guess: the axes are ARKit's, y up, as in other apps' files. They are OpenCV's: ARKit's do not fit matches."""
    capture = read_capture(source)
    matches = find_matches(capture, motion_of(capture))
    share = {
        way: by_convention(matches, capture.world_from_cam @ np.diag([1, way, way, 1]))[AS_READ] for way in (1, -1)
    }
    assert share[1] > 0.8 > 0.3 > share[-1]


def test_each_frame_has_its_own_lens_in_newer_versions(source, walk):
    header = f"{HEADER}, fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    (source / "odometry.csv").write_text(odometry(walk[0], header, ", 300.0, 301.0, 160.25, 120.75, , "))
    (camera,) = read_capture(source).cameras.values()
    assert (camera.focal_px, camera.center_px) == ((300, 301), (159.75, 120.25))
    (source / "odometry.csv").write_text(odometry(walk[0], header, ", , , , , , "))  # empty: that of the matrix
    (camera,) = read_capture(source).cameras.values()
    assert camera.focal_px[0] == pytest.approx(default_intrinsics(SIZE)[0, 0])


def test_frames_are_those_that_the_film_stores(source, walk):
    """The matrix is the sensor's: a video that asks to be shown upright is not turned."""
    data = bytearray((source / "rgb.mp4").read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    assert struct.unpack_from(">9i", data, at) == (1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, at, 0, 1 << 16, 0, -(1 << 16), 0, 0, SIZE[1] << 16, 0, 1 << 30)  # a quarter turn
    (source / "rgb.mp4").unlink()
    (source / "rgb.mp4").write_bytes(data)
    assert cv2.VideoCapture(str(source / "rgb.mp4")).read()[1].shape[:2] == SIZE  # it does ask
    (camera,) = read_capture(source).cameras.values()
    assert (camera.width, camera.height) == SIZE


def test_poses_after_the_end_of_the_film_are_counted(source, walk):
    poses = np.concatenate((walk[0], walk[0][:2]))
    (source / "odometry.csv").write_text(odometry(poses))
    assert read_capture(source).poses_without_image == ("rgb.mp4, frame 40", "rgb.mp4, frame 41")


def test_a_row_of_no_pose_is_nan(source, walk):
    number = int(read_capture(source).images[1].stem)
    lines = (source / "odometry.csv").read_text().splitlines()
    lines[1 + number] = f"{FIRST_S}, {number:06d}, 0, 0, 0, 0, 0, 0, 0"
    (source / "odometry.csv").write_text("\n".join(lines))
    assert np.isnan(read_capture(source).world_from_cam[1]).all()


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("odometry.csv", "", "names no column 'timestamp'"),
        ("odometry.csv", "1, 2, 3\n", "names no column 'timestamp'"),
        ("odometry.csv", HEADER + "\n", "has no row below its header"),
        ("odometry.csv", HEADER + "\n1, 0, 0, 0\n", "line 2: is not a row timestamp, frame"),
        ("odometry.csv", HEADER + "\n1, 0, 0, 0, 0, x, 0, 0, 1\n", "line 2: is not a row timestamp, frame"),
        ("odometry.csv", HEADER + "\nnan, 0, 0, 0, 0, 0, 0, 0, 1\n", "line 2: is not a row timestamp, frame"),
        ("odometry.csv", HEADER + "\n1, 0.5, 0, 0, 0, 0, 0, 0, 1\n", "line 2: 0.5 is not a frame's number"),
        ("odometry.csv", HEADER + "\n1, 900, 0, 0, 0, 0, 0, 0, 1\n", "no pose of a frame that was chosen"),
        ("odometry.csv", HEADER + "\n1, 0, 0, 0, 0, 9, 0, 0, 1\n", "far from unit length"),
        ("camera_matrix.csv", "1, 2\n3, 4\n", "is not a 3x3 matrix"),
        ("camera_matrix.csv", "1,0,x\n0,1,3\n0,0,1\n", "is not a 3x3 matrix"),
        ("camera_matrix.csv", "1600,0,960\n0,1600,720\n0,0,1\n", "principal point 960, 720 is far from the centre"),
        ("rgb.mp4", "no video", "rgb.mp4: cannot be opened"),
    ],
)
def test_what_is_damaged_is_named(source, refused, file, content, says):
    (source / file).unlink()
    (source / file).write_text(content)
    refused(read_stray_scanner, source, file, says)
