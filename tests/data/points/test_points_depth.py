"""Scene points from depth frames, against the rendered room, OpenCV's projection and depth written by hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.data.cameras import known_cameras
from mambaloc.data.datasets.seven_scenes import read_split
from mambaloc.data.frames import BadFrames, Cameras, Frames
from mambaloc.data.points import ScenePoints, read_points
from mambaloc.errors import InputError
from mambaloc.rendering import default_intrinsics, frames_of_sequences, furnished_room, write_7scenes
from mambaloc.rendering.trajectories import smooth_trajectory

SIZE = (96, 72)
INSIDE_M = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))
DEPTH_EVERY = 5


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    """Two training sequences of 12 frames, depth for frames 0, 5 and 10 of each."""
    shots = frames_of_sequences({n: smooth_trajectory(12, n, INSIDE_M) for n in (1, 2)}, test=())
    room = furnished_room(INSIDE_M, seed=0, px_per_m=30)
    root = tmp_path_factory.mktemp("depth")
    return write_7scenes(root, "den", shots, room=room, size=SIZE, depth=True, depth_every=DEPTH_EVERY)


@pytest.fixture(scope="module")
def frames(rendered) -> Frames:
    return read_split(rendered, "train", BadFrames())


@pytest.fixture(scope="module")
def cameras(rendered, frames) -> Cameras:
    return known_cameras("7scenes", rendered, frames)


@pytest.fixture(scope="module")
def points(rendered, frames, cameras) -> ScenePoints:
    return read_points(rendered, frames, cameras, 40, seed=0)


def seen(
    points: ScenePoints, frames: Frames, row: int, camera: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A frame's points (K, 3), the pixels that OpenCV projects them to (K, 2), and their depths in metres (K,)."""
    points_m = points.points_m[row][np.isfinite(points.points_m[row]).all(axis=1)].astype(float)
    cam_from_world = Rotation.from_quat(np.roll(frames.quaternion[row], -1)).inv()
    t = -cam_from_world.apply(frames.position_m[row])
    camera = default_intrinsics(SIZE) if camera is None else camera
    pixels = cv2.projectPoints(points_m, cam_from_world.as_rotvec(), t, camera, None)[0][:, 0]
    return points_m, pixels, cam_from_world.apply(points_m)[:, 2] + t[2]


def depth_file(image: Path) -> Path:
    return image.with_name(image.name.replace(".color.png", ".depth.png"))


def test_points_lie_on_what_the_frame_shows(points, frames):
    assert points.source == "depth"
    assert (points.points_m.shape, points.points_m.dtype) == ((24, 40, 3), np.float32)
    for row in (0, 5, 10, 12, 17, 22):
        _, pixels, z_m = seen(points, frames, row)
        x, y = np.round(pixels).astype(int).T
        assert len(pixels) == len({*zip(x.tolist(), y.tolist(), strict=True)}) == 40
        np.testing.assert_allclose(pixels, np.stack([x, y], axis=1), atol=0.01)
        depth_mm = cv2.imread(str(depth_file(frames.image_paths[row])), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(z_m * 1000, depth_mm[y, x], atol=0.01)


@pytest.mark.parametrize(("row", "lenders"), [(2, (0, 5)), (9, (5, 10)), (11, (10,)), (14, (12, 17)), (23, (22,))])
def test_a_frame_without_depth_borrows_what_it_sees_of_its_neighbours(points, frames, row, lenders):
    borrowed, pixels, z_m = seen(points, frames, row)
    owned = {tuple(point) for lender in lenders for point in seen(points, frames, lender)[0]}
    assert len(borrowed) > 10
    assert {tuple(point) for point in borrowed} <= owned
    assert (z_m > 0).all()
    assert ((pixels > -0.501) & (pixels < np.array(SIZE) - 0.499)).all()


def test_only_depth_of_the_frames_asked_for_is_used(rendered, frames, points):
    kept = np.array([0, 2, 10, 11, 13])  # without frame 5; and 13 alone of the second sequence, without depth
    of_kept = frames.select(kept)
    few = read_points(rendered, of_kept, known_cameras("7scenes", rendered, of_kept), 40, seed=0)
    owned = {tuple(point) for row in (0, 10) for point in points.points_m[row]}
    assert {tuple(point) for point in few.points_m[1] if np.isfinite(point).all()} <= owned
    assert few.per_frame()[-1] == 0
    for row, of in enumerate(kept[[0, 2]]):
        np.testing.assert_array_equal(few.points_m[2 * row], points.points_m[of])  # whichever others are read


def test_points_depend_on_the_seed_alone(rendered, frames, cameras, points):
    again, other = (read_points(rendered, frames, cameras, 40, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(again.points_m, points.points_m)
    assert not np.array_equal(other.points_m[0], points.points_m[0])
    assert (np.diff(points.points_m[[0, 5]], axis=0) != 0).any()


def write_depth(image: Path, depth_mm: np.ndarray) -> None:
    cv2.imwrite(str(depth_file(image)), depth_mm)


@pytest.fixture
def tiny(write_tiny_scene):
    return write_tiny_scene({1: 3})


DEPTH_CAMERA = np.array([[585 / 20, 0, 320.5 / 20 - 0.5], [0, 585 / 20, 240.5 / 20 - 0.5], [0, 0, 1]])
"""The official depth sensor's, in pixels of frames of 32x24."""


def read_tiny(folder: Path, count: int) -> ScenePoints:
    frames = read_split(folder, "train", BadFrames())
    return read_points(folder, frames, known_cameras("7scenes", folder, frames), count, seed=3)


def test_invalid_depth_is_never_used(tiny):
    depth_mm = np.zeros((24, 32), np.uint16)
    depth_mm[::2] = 65535
    depth_mm[7, 3], depth_mm[10, 31], depth_mm[0, 0] = 1200, 65534, 1
    write_depth(tiny.images[0], depth_mm)
    write_depth(tiny.images[1], np.zeros((24, 32), np.uint16))
    frames = read_split(tiny.folder, "train", BadFrames())
    points = read_tiny(tiny.folder, 10)
    _, pixels, z_m = seen(points, frames, 0, DEPTH_CAMERA)
    found = {(*np.round(pixel).astype(int).tolist(), round(1000 * z)) for pixel, z in zip(pixels, z_m, strict=True)}
    assert found == {(3, 7, 1200), (31, 10, 65534), (0, 0, 1)}
    assert points.per_frame()[1] == 0


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (32, 24)])
def test_without_a_file_the_depth_camera_is_the_official_one_at_any_size(tiny, size):
    depth_mm = np.zeros(size[::-1], np.uint16)
    depth_mm[2, 3] = 900
    write_depth(tiny.images[0], depth_mm)
    scale = size[0] / 640
    by_hand = np.array([[585 * scale, 0, 320.5 * scale - 0.5], [0, 585 * scale, 240.5 * scale - 0.5], [0, 0, 1]])
    _, pixels, z_m = seen(read_tiny(tiny.folder, 5), read_split(tiny.folder, "train", BadFrames()), 0, by_hand)
    np.testing.assert_allclose([[*pixels[0], z_m[0]]], [[3, 2, 0.9]], atol=1e-4)


def test_the_scenes_own_depth_camera_comes_first(tiny):
    depth_mm = np.zeros((24, 32), np.uint16)
    depth_mm[2, 3] = 900
    write_depth(tiny.images[0], depth_mm)
    (tiny.folder / "camera-intrinsics.txt").write_text("30 0 15\n0 31 11\n\n0 0 1\n")
    camera = np.array([[30.0, 0, 15], [0, 31, 11], [0, 0, 1]])
    _, pixels, z_m = seen(read_tiny(tiny.folder, 5), read_split(tiny.folder, "train", BadFrames()), 0, camera)
    np.testing.assert_allclose([[*pixels[0], z_m[0]]], [[3, 2, 0.9]], atol=1e-4)


def test_a_frame_borrows_what_its_color_camera_sees(tiny):
    """Frames of one pose, depth of one: a camera with a narrower view sees fewer of its points."""
    write_depth(tiny.images[0], np.full((24, 32), 900, np.uint16))
    for image in tiny.images[1:]:
        np.savetxt(image.with_name(image.name.replace("color.png", "pose.txt")), tiny.world_from_cam[0])
    frames = read_split(tiny.folder, "train", BadFrames())
    wide = known_cameras("7scenes", tiny.folder, frames)
    narrow = Cameras(wide.intrinsics.copy(), wide.size_px)
    narrow.intrinsics[1, 0, 0] *= 2
    points = read_points(tiny.folder, frames, narrow, 32 * 24, seed=0)
    assert points.per_frame()[2] == points.per_frame()[0] == 32 * 24
    _, pixels, _ = seen(points, frames, 1, narrow.intrinsics[1])
    of_all = seen(points, frames, 0, narrow.intrinsics[1])[1]
    assert len(pixels) == (np.abs(of_all[:, 0] - 15.5) < 16).sum() < 32 * 24


def one_line(folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_tiny(folder, 5)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "585 0 320\n0 585 240\n",
        "a 0 1\n0 1 1\n0 0 1",
        "1 0 1\n0 1 1 1\n0 0 1",
        "nan 0 1\n0 1 1\n0 0 1",
        "-5 0 1\n0 5 1\n0 0 1",
    ],
)
def test_bad_intrinsics_are_named(tiny, text):
    write_depth(tiny.images[0], np.full((24, 32), 900, np.uint16))
    (tiny.folder / "camera-intrinsics.txt").write_text(text)
    assert "camera-intrinsics.txt: is not a pinhole matrix" in one_line(tiny.folder)


@pytest.mark.parametrize("damage", ["truncated", "empty", "text", "8 bit", "colour"])
def test_a_damaged_depth_frame_is_named(tiny, damage):
    write_depth(tiny.images[0], np.full((24, 32), 900, np.uint16))
    write_depth(tiny.images[1], np.full((24, 32), 900, np.uint16))
    file = depth_file(tiny.images[1])
    content = {"truncated": file.read_bytes()[:-20], "empty": b"", "text": b"text"}
    if damage in content:
        file.write_bytes(content[damage])
    else:
        cv2.imwrite(str(file), np.zeros((24, 32) if damage == "8 bit" else (24, 32, 3), np.uint8))
    assert "frame-000001.depth.png: is not a complete 16-bit PNG of one channel" in one_line(tiny.folder)


def test_depth_of_another_size_is_named(tiny):
    write_depth(tiny.images[0], np.full((24, 32), 900, np.uint16))
    write_depth(tiny.images[2], np.full((12, 16), 900, np.uint16))
    assert "frame-000002.depth.png: is 16x12, where the first depth frame is 32x24" in one_line(tiny.folder)


def test_no_point_at_all_is_an_error(tiny):
    write_depth(tiny.images[0], np.zeros((24, 32), np.uint16))
    assert "its depth has no point for any of 3 frames" in one_line(tiny.folder)


def test_without_any_source_the_three_places_are_named(tiny):
    message = one_line(tiny.folder)
    for place in ("seq-01/frame-000000.depth.png", "reconstruction.nvm", "sparse/0 or sparse"):
        assert place in message


@pytest.mark.slow
def test_real_depth_gives_every_frame_points(shared_data):
    folder = shared_data / "7scenes_blocks" / "redkitchen"
    if not folder.is_dir():
        pytest.skip(f"no real scene at {folder}")
    frames = read_split(folder, "test", BadFrames())
    cameras = known_cameras("7scenes", folder, frames)
    points = read_points(folder, frames, cameras, 100, seed=0)
    assert points.per_frame().min() > 50  # frames between two with depth see most of what those see
    assert np.nanmax(np.abs(points.points_m)) < 10
