"""Scene points from depth frames, against the rendered room, OpenCV's projection and depth written by hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.data.datasets.seven_scenes import read_split
from mambaloc.data.frames import BadFrames, Frames
from mambaloc.data.points import ScenePoints, read_points
from mambaloc.errors import InputError
from mambaloc.rendering import default_intrinsics, furnished_room, shots_of_sequences, write_7scenes
from mambaloc.rendering.trajectories import smooth_trajectory

SIZE = (96, 72)
INSIDE_M = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))
DEPTH_EVERY = 5


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    """Two training sequences of 12 frames, depth for frames 0, 5 and 10 of each."""
    shots = shots_of_sequences({n: smooth_trajectory(12, n, INSIDE_M) for n in (1, 2)}, test=())
    room = furnished_room(INSIDE_M, seed=0, px_per_m=30)
    root = tmp_path_factory.mktemp("depth")
    return write_7scenes(root, "den", shots, room=room, size=SIZE, depth=True, depth_every=DEPTH_EVERY)


@pytest.fixture(scope="module")
def frames(rendered) -> Frames:
    return read_split(rendered, "train", BadFrames())


@pytest.fixture(scope="module")
def points(rendered, frames) -> ScenePoints:
    return read_points(rendered, frames, 40, seed=0)


def seen(points: ScenePoints, frames: Frames, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A frame's points (K, 3), the pixels that OpenCV projects them to (K, 2), and their depths in metres (K,)."""
    points_m = points.points_m[row][np.isfinite(points.points_m[row]).all(axis=1)].astype(float)
    cam_from_world = Rotation.from_quat(np.roll(frames.quaternion[row], -1)).inv()
    t = -cam_from_world.apply(frames.position_m[row])
    camera = points.intrinsics[row].astype(float)
    pixels = cv2.projectPoints(points_m, cam_from_world.as_rotvec(), t, camera, None)[0][:, 0]
    return points_m, pixels, cam_from_world.apply(points_m)[:, 2] + t[2]


def depth_file(image: Path) -> Path:
    return image.with_name(image.name.replace(".color.png", ".depth.png"))


def test_points_lie_on_what_the_frame_shows(points, frames):
    assert points.source == "depth"
    assert points.size_px == SIZE
    assert points.points_m.shape == (24, 40, 3)
    assert (points.points_m.dtype, points.intrinsics.dtype) == (np.float32, np.float32)
    np.testing.assert_allclose(points.intrinsics, np.tile(default_intrinsics(SIZE), (24, 1, 1)))
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
    few = read_points(rendered, frames.select(kept), 40, seed=0)
    owned = {tuple(point) for row in (0, 10) for point in points.points_m[row]}
    assert {tuple(point) for point in few.points_m[1] if np.isfinite(point).all()} <= owned
    assert few.per_frame()[-1] == 0
    for row, of in enumerate(kept[[0, 2]]):
        np.testing.assert_array_equal(few.points_m[2 * row], points.points_m[of])  # whichever others are read


def test_points_depend_on_the_seed_alone(rendered, frames, points):
    again, other = (read_points(rendered, frames, 40, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(again.points_m, points.points_m)
    assert not np.array_equal(other.points_m[0], points.points_m[0])
    assert (np.diff(points.points_m[[0, 5]], axis=0) != 0).any()


def write_depth(image: Path, depth_mm: np.ndarray) -> None:
    cv2.imwrite(str(depth_file(image)), depth_mm)


@pytest.fixture
def tiny(write_tiny_scene):
    return write_tiny_scene({1: 3})


def test_invalid_depth_is_never_used(tiny):
    depth_mm = np.zeros((24, 32), np.uint16)
    depth_mm[::2] = 65535
    depth_mm[7, 3], depth_mm[10, 31], depth_mm[0, 0] = 1200, 65534, 1
    write_depth(tiny.images[0], depth_mm)
    write_depth(tiny.images[1], np.zeros((24, 32), np.uint16))
    frames = read_split(tiny.folder, "train", BadFrames())
    points = read_points(tiny.folder, frames, 10, seed=3)
    _, pixels, z_m = seen(points, frames, 0)
    found = {(*np.round(pixel).astype(int).tolist(), round(1000 * z)) for pixel, z in zip(pixels, z_m, strict=True)}
    assert found == {(3, 7, 1200), (31, 10, 65534), (0, 0, 1)}
    assert points.per_frame()[1] == 0


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (32, 24)])
def test_without_a_file_the_camera_is_the_official_one_at_any_size(tiny, size):
    write_depth(tiny.images[0], np.full(size[::-1], 900, np.uint16))
    points = read_points(tiny.folder, read_split(tiny.folder, "train", BadFrames()), 5, seed=0)
    scale = size[0] / 640
    by_hand = [[585 * scale, 0, 320.5 * scale - 0.5], [0, 585 * scale, 240.5 * scale - 0.5], [0, 0, 1]]
    np.testing.assert_allclose(points.intrinsics[0], by_hand, rtol=1e-6)
    assert points.size_px == size


def test_the_scenes_own_camera_comes_first(tiny):
    write_depth(tiny.images[0], np.full((24, 32), 900, np.uint16))
    (tiny.folder / "camera-intrinsics.txt").write_text("30 0 15\n0 31 11\n\n0 0 1\n")
    points = read_points(tiny.folder, read_split(tiny.folder, "train", BadFrames()), 5, seed=0)
    np.testing.assert_array_equal(points.intrinsics[2], [[30, 0, 15], [0, 31, 11], [0, 0, 1]])


def one_line(folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_points(folder, read_split(folder, "train", BadFrames()), 5, seed=0)
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
    assert "camera-intrinsics.txt: is no pinhole matrix" in one_line(tiny.folder)


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
    assert "frame-000001.depth.png: is no whole 16-bit PNG of one channel" in one_line(tiny.folder)


def test_depth_of_another_size_is_named(tiny):
    write_depth(tiny.images[0], np.full((24, 32), 900, np.uint16))
    write_depth(tiny.images[2], np.full((12, 16), 900, np.uint16))
    assert "frame-000002.depth.png: is 16x12, where the first depth frame is 32x24" in one_line(tiny.folder)


def test_no_point_at_all_is_an_error(tiny):
    write_depth(tiny.images[0], np.zeros((24, 32), np.uint16))
    assert "its depth holds no point for any of 3 frames" in one_line(tiny.folder)


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
    points = read_points(folder, frames, 100, seed=0)
    assert points.per_frame().min() > 50  # frames between two with depth see most of what those see
    assert np.nanmax(np.abs(points.points_m)) < 10
    assert points.size_px == (640, 480)
    np.testing.assert_array_equal(points.intrinsics[7], [[585, 0, 320], [0, 585, 240], [0, 0, 1]])
