"""Scene points from NVM and COLMAP models: true poses and tracks, other frames refused, damaged files named."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.data.cameras import known_cameras, known_or_assumed_cameras
from mambaloc.data.datasets.cambridge import read_split
from mambaloc.data.frames import BadFrames, Frames
from mambaloc.data.points import ScenePoints, colmap, read_points
from mambaloc.errors import InputError, InputWarning
from mambaloc.rendering import default_intrinsics, frames_of_sequences, furnished_room, render, write_cambridge
from mambaloc.rendering.trajectories import smooth_trajectory

SIZE = (96, 72)
INSIDE_M = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))
HEADER = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"


def finite(points_m: np.ndarray) -> np.ndarray:
    return points_m[np.isfinite(points_m).all(axis=1)]


# --- NVM: a rendered scene -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room():
    return furnished_room(INSIDE_M, seed=0, px_per_m=30)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory, room) -> Path:
    shots = frames_of_sequences(
        {n: smooth_trajectory(6, n, INSIDE_M) for n in (1, 2)}, test=(2,), image="seq{sequence}/frame{frame:05d}.png"
    )
    return write_cambridge(tmp_path_factory.mktemp("nvm"), "Yard", shots, room=room, size=SIZE, points=True)


def pixels_and_depths(points_m: np.ndarray, frames: Frames, row: int) -> tuple[np.ndarray, np.ndarray]:
    cam_from_world = Rotation.from_quat(np.roll(frames.quaternion[row], -1)).inv()
    t = -cam_from_world.apply(frames.position_m[row])
    pixels = cv2.projectPoints(points_m, cam_from_world.as_rotvec(), t, default_intrinsics(SIZE), None)[0][:, 0]
    return pixels, cam_from_world.apply(points_m)[:, 2] + t[2]


@pytest.mark.parametrize("split", ["train", "test"])
def test_tracked_points_are_what_the_frame_shows(rendered, room, split):
    frames = read_split(rendered, split, BadFrames())
    points = read_points(rendered, frames, known_cameras("cambridge", rendered, frames), 200, seed=0)
    assert (points.source, points.points_m.shape) == ("nvm", (6, 200, 3))
    assert points.per_frame().min() > 100
    for row in range(6):
        pixels, z_m = pixels_and_depths(finite(points.points_m[row]).astype(float), frames, row)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(np.roll(frames.quaternion[row], -1)).as_matrix()
        pose[:3, 3] = frames.position_m[row]
        x, y = np.round(pixels).astype(int).T
        depth_m = render(room, default_intrinsics(SIZE), pose, SIZE)[1][y, x]
        np.testing.assert_allclose(z_m, depth_m, rtol=0.025)


def test_rendered_tracks_hold_the_pixels_that_opencv_projects(rendered):
    frames = {
        path.stem: (of, row)
        for split in ("train", "test")
        for of in [read_split(rendered, split, BadFrames())]
        for row, path in enumerate(of.image_paths)
        if split == "train"
    }
    lines = (rendered / "reconstruction.nvm").read_text().splitlines()
    assert lines[0] == "NVM_V3"
    names = [line.split()[0] for line in lines[3:15]]
    assert names[:6] == [f"seq1/frame{k:05d}.jpg" for k in range(6)]
    for line in lines[17:200:13]:
        words = line.split()
        track = np.array(words[7:], dtype=float).reshape(-1, 4)
        assert len(track) == int(words[6]) > 1
        for camera, _, x, y in track[track[:, 0] < 6]:
            of, row = frames[Path(names[int(camera)]).stem]
            pixels, _ = pixels_and_depths(np.array([words[:3]], dtype=float), of, row)
            np.testing.assert_allclose((x + 47.5, y + 35.5), pixels[0], atol=0.01)


def test_the_pictures_do_not_depend_on_the_points(rendered, room, tmp_path):
    shots = frames_of_sequences({1: smooth_trajectory(2, 1, INSIDE_M)}, (), "seq{sequence}/frame{frame:05d}.png")
    plain = write_cambridge(tmp_path, "Plain", shots, room=room, size=SIZE)
    assert not (plain / "reconstruction.nvm").exists()
    for shot in shots:
        assert (plain / shot.image).read_bytes() == (rendered / shot.image).read_bytes()


# --- NVM: written by hand --------------------------------------------------------------------------------------------


CAMERAS = [
    "seq1/a.jpg 100 1 0 0 0 1 2 3 0 0",
    "seq1/b.jpg 110 0 0 0 1 4 5 6 -0.1 0",
    "seq1/other.jpg 90 1 0 0 0 9 9 9 0 0",
]
POINTS = [
    "1 2 9 0 0 0 2 0 0 1 1 1 0 2 2",
    "3 2 9 9 9 9 2 0 1 3 3 2 0 4 4",
    "5 5 5 0 0 0 1 1 1 0 0",
    "7e6 0 0 0 0 0 1 0 2 0 0",
]


def nvm(cameras: list[str], points: list[str], head: str = "NVM_V3 ", tail: str = "0\n#PLY\n0\n") -> str:
    return "\n".join([head, "", str(len(cameras)), *cameras, "", str(len(points)), *points, "", tail])


@pytest.fixture
def yard(tmp_path) -> Path:
    """Four frames of 40x30 without a model; c looks elsewhere, and no camera of the model below is d."""
    (tmp_path / "seq1").mkdir()
    lines = ["a.png 1 2 3 1 0 0 0", "b.png 4 5 6 0 0 0 1", "c.png 0 0 0 1 0 0 0", "d.png 0 0 0 1 0 0 0"]
    for line in lines:
        cv2.imwrite(str(tmp_path / "seq1" / line.split()[0]), np.zeros((30, 40, 3), np.uint8))
    (tmp_path / "dataset_train.txt").write_text(HEADER + "".join(f"seq1/{line}\n" for line in lines))
    return tmp_path


def read(yard: Path, text: str | None = None, count: int = 5) -> ScenePoints:
    if text is not None:
        (yard / "reconstruction.nvm").write_text(text)
    frames = read_split(yard, "train", BadFrames())
    return read_points(yard, frames, known_or_assumed_cameras("cambridge", yard, frames), count, seed=0)


@pytest.mark.parametrize("tail", ["", "0\n", "2\nx y\n", "0\n#the last part of NVM file points to the PLY files\n0\n"])
def test_each_frame_has_the_points_whose_track_lists_its_image(yard, tail):
    points = read(yard, nvm(CAMERAS, POINTS, tail=tail))
    assert points.per_frame().tolist() == [2, 2, 0, 0]
    np.testing.assert_array_equal(finite(points.points_m[0]), [[1, 2, 9], [3, 2, 9]])  # and none 7000 km away
    np.testing.assert_array_equal(finite(points.points_m[1]), [[1, 2, 9], [5, 5, 5]])


def test_each_frame_has_the_focal_length_of_its_image(yard):
    (yard / "reconstruction.nvm").write_text(nvm([*CAMERAS, "seq1/c.jpg 90 1 0 0 0 7 7 7 0 0"], POINTS))
    cameras = known_cameras("cambridge", yard, read_split(yard, "train", BadFrames()))
    assert cameras.intrinsics[:, 0, 0].tolist() == [100, 110, 90, 100]  # d is unknown: the median of the known
    np.testing.assert_array_equal(cameras.intrinsics[1], [[110, 0, 19.5], [0, 110, 14.5], [0, 0, 1]])
    assert (cameras.size_px == (40, 30)).all()
    assert not cameras.is_assumed


@pytest.mark.parametrize("damage", ["NVM_V3\n3\n" + CAMERAS[0], nvm([CAMERAS[0].replace("100", "-1")], [])])
def test_a_damaged_model_stops_the_run_that_would_have_its_cameras(yard, damage):
    (yard / "reconstruction.nvm").write_text(damage)
    with pytest.raises(InputError, match=r"reconstruction\.nvm.* get it again"):
        known_or_assumed_cameras("cambridge", yard, read_split(yard, "train", BadFrames()))


def test_cameras_of_other_images_are_not_those_of_the_frames(yard):
    (yard / "reconstruction.nvm").write_text(nvm(["seq9/z.jpg 100 1 0 0 0 1 2 3 0 0"], []))
    frames = read_split(yard, "train", BadFrames())
    with pytest.warns(InputWarning, match=r"nvm: has no camera of 4 frames, such as .*a\.png\. .* 0\.87 of .* assumed"):
        cameras = known_or_assumed_cameras("cambridge", yard, frames)
    np.testing.assert_allclose(cameras.intrinsics, [[[34.8, 0, 19.5], [0, 34.8, 14.5], [0, 0, 1]]] * 4)
    assert cameras.is_assumed


def test_too_many_points_are_drawn_from(yard):
    many = [f"{k} 0 9 0 0 0 1 0 {k} 0 0" for k in range(50)]
    points = read(yard, nvm(CAMERAS, many))
    drawn = points.points_m[0, :, 0]
    assert len(set(drawn.tolist())) == 5
    np.testing.assert_array_equal(read(yard).points_m, points.points_m)


def test_a_frame_whose_pose_differs_has_no_points(yard):
    off = "seq1/c.jpg 100 1 0 0 0 0 0 0.5 0 0"
    assert read(yard, nvm([*CAMERAS, off], [*POINTS, "1 1 1 0 0 0 1 3 0 0 0"])).per_frame().tolist() == [2, 2, 0, 0]


@pytest.mark.parametrize(
    ("a", "b", "says"),
    [
        ("1 0 0 0 10 20 30", "0 0 0 1 40 50 60", "up to 79 m and 0 degrees off"),
        ("0 1 0 0 1 2 3", "1 0 0 0 4 5 6", "up to 0 m and 180 degrees off"),
    ],
)
def test_a_model_in_another_frame_or_scale_is_refused(yard, a, b, says):
    with pytest.raises(InputError, match=r"reconstruction\.nvm: its cameras are") as caught:
        read(yard, nvm([f"seq1/a.jpg 100 {a} 0 0", f"seq1/b.jpg 100 {b} 0 0"], POINTS[:1]))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 0: does not begin with NVM_V3"),
        ("ply\n", "line 1: does not begin with NVM_V3"),
        ("NVM_V3\n", "is not the number of cameras"),
        ("NVM_V3\n-1\n", "line 2: is not the number of cameras"),
        ("NVM_V3\n1e3\n", "line 2: is not the number of cameras"),
        (f"NVM_V3\n{'9' * 5000}\n", "line 2: is not the number of cameras"),
        ("NVM_V3\n999999999999999\n" + CAMERAS[0], "ends after 1 of 999999999999999 cameras; it is truncated"),
        ("NVM_V3\n2\n" + CAMERAS[0] + "\n\n1\n" + POINTS[0], "line 5: is not a camera"),
        ("NVM_V3\n1\n" + "\n".join(CAMERAS), "line 4: is not the number of points"),
        (nvm([CAMERAS[0].replace("100", "x")], []), "line 4: is not a camera"),
        (nvm([CAMERAS[0].replace("100", "nan")], []), "line 4: is not a camera"),
        (nvm([CAMERAS[0].replace("100", "0")], []), "line 4: is a camera with a focal length of 0 or less"),
        (nvm([CAMERAS[0].replace(" 1 0 0 0 ", " 0 0 0 0 ")], []), "line 4: is a camera with"),
        (nvm(CAMERAS, POINTS).partition("7e6")[0], "ends after 3 of 4 points"),
        (
            "NVM_V3\n1\n" + CAMERAS[0] + "\n88888888888\n" + "1 2 3 0 0 0 1 0 0 0 0",
            "ends after 1 of 88888888888 points",
        ),
        (nvm(CAMERAS, ["1 2"]), "line 9: is not a point"),
        (nvm(CAMERAS, ["1 2 x 0 0 0 0"]), "line 9: is not a point"),
        (nvm(CAMERAS, ["1 2 inf 0 0 0 0"]), "line 9: is a point whose position is not finite"),
        (nvm(CAMERAS, ["1 2 3 0 0 0 2 0 0 0 0"]), "line 9: is a point with a track of 2, but has 4 numbers of it"),
        (nvm(CAMERAS, ["1 2 3 0 0 0 -1"]), "line 9: is a point with a track of -1"),
        (nvm(CAMERAS, ["1 2 3 0 0 0 999999999999 0 0 0 0"]), "line 9: is a point with a track of 999999999999"),
        (
            nvm(CAMERAS, ["1 2 3 0 0 0 1 3 0 0 0"]),
            "line 9: is a point seen by an image that is not one of the 3 cameras",
        ),
        (
            nvm(CAMERAS, ["1 2 3 0 0 0 1 -1 0 0 0"]),
            "line 9: is a point seen by an image that is not one of the 3 cameras",
        ),
        (nvm(CAMERAS, POINTS, tail=POINTS[0]), "line 14: follows the last of the points"),
        ("NVM_V3\n" + "1" * (1 << 22), "line 2: is too long"),
        (nvm(["seq9/z.jpg 100 1 0 0 0 1 2 3 0 0"], []), "contains none of 4 frames, such as"),
        (nvm([". 100 1 0 0 0 1 2 3 0 0"], []), "contains none of 4 frames, such as"),
        (nvm(CAMERAS, POINTS[3:]), "its nvm has no point for any of 4 frames"),
        ("NVM_V3\n\x00\xff\n", "line 2: is not the number of cameras"),
    ],
)
def test_a_malformed_file_is_named_in_one_line(yard, text, says):
    with pytest.raises(InputError) as caught:
        read(yard, text)
    assert says in str(caught.value)
    assert str(yard) in str(caught.value)
    assert "\n" not in str(caught.value)


# --- COLMAP ----------------------------------------------------------------------------------------------------------


def write_model(folder: Path, binary: bool, camera_model: str = "SIMPLE_RADIAL", shift_m: float = 0.0) -> None:
    """The yard's frames a and b at twice their size, and two points; poses and points written by pycolmap."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, the extra [colmap], writes the models")
    model = pycolmap.Reconstruction()
    params = {"SIMPLE_RADIAL": [100.0, 41.0, 29.0, 0.05], "PINHOLE": [100.0, 102.0, 41.0, 29.0]}[camera_model]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=camera_model, width=80, height=60, params=params)
    )
    for number, (name, xyzw, center) in enumerate([("a", [0, 0, 0, 1], [1, 2, 3]), ("b", [0, 0, 1, 0], [4, 5, 6])]):
        rotation = Rotation.from_quat(xyzw)
        observations = pycolmap.Point2DList([pycolmap.Point2D(np.zeros(2)) for _ in range(2)])
        image = pycolmap.Image(name=f"seq1/{name}.jpg", camera_id=1, image_id=number + 1, points2D=observations)
        t = -rotation.apply(np.add(center, (shift_m, 0, 0)))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(xyzw, float)), t))
    for xyz, seen_by in (([1.0, 2, 9], ((1, 0), (2, 0))), ([5.0, 5, 5], ((2, 1),))):
        track = pycolmap.Track()
        for image_id, feature in seen_by:
            track.add_element(image_id, feature)
        model.add_point3D(np.array(xyz), track, np.zeros(3, np.uint8))
    folder.mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(str(folder))


@pytest.mark.parametrize(
    ("place", "binary", "camera_model"), [("sparse/0", True, "SIMPLE_RADIAL"), ("sparse", False, "PINHOLE")]
)
def test_a_colmap_model_is_read_as_it_was_written(yard, place, binary, camera_model):
    write_model(yard / place, binary, camera_model)
    points = read(yard)
    assert points.source == "colmap"
    assert points.per_frame().tolist() == [1, 2, 0, 0]
    np.testing.assert_array_equal(finite(points.points_m[0]), [[1, 2, 9]])
    np.testing.assert_array_equal(sorted(finite(points.points_m[1]).tolist()), [[1, 2, 9], [5, 5, 5]])
    cameras = known_cameras("cambridge", yard, read_split(yard, "train", BadFrames()))
    focal_y = 51 if camera_model == "PINHOLE" else 50  # the model is of images of twice the size, 80x60
    by_hand = [[50, 0, 41 / 2 - 0.5], [0, focal_y, 29 / 2 - 0.5], [0, 0, 1]]  # COLMAP counts from the corner
    np.testing.assert_allclose(cameras.intrinsics, [by_hand] * 4)
    assert (cameras.size_px == (40, 30)).all()


def test_a_colmap_model_in_another_frame_is_refused(yard):
    write_model(yard / "sparse", binary=True, shift_m=0.3)
    with pytest.raises(InputError, match=r"sparse: its cameras are up to 0\.3 m and 0 degrees off"):
        read(yard)


@pytest.mark.parametrize(
    ("file", "keep"),
    [
        ("images.bin", 40),
        ("images.bin", 0),
        ("points3D.bin", 60),
        ("points3D.bin", 30),
        ("frames.bin", 50),
        ("cameras.bin", 12),
        ("cameras.bin", 60),
    ],
)
def test_a_damaged_colmap_model_is_named_in_one_line(yard, file, keep):
    write_model(yard / "sparse/0", binary=True)
    damaged = yard / "sparse/0" / file
    damaged.write_bytes(damaged.read_bytes()[:keep])
    with (
        mock.patch("pycolmap.Reconstruction", side_effect=AssertionError("COLMAP would read past the end")),
        pytest.raises(InputError, match=rf"sparse/0/{file}: is truncated") as caught,
    ):
        read(yard)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("file", "line", "says"),
    [
        ("points3D.txt", "", "its colmap has no point for any of 4 frames"),
        ("cameras.txt", "1 PINHOLE 0 60 100 102 41 29\n", "holds a camera without a size"),
        ("cameras.txt", "1 PINHOLE 80 60 0 102 41 29\n", "holds a camera without a size"),
        ("cameras.txt", "1 PINHOLE 80 60 nan 102 41 29\n", "is not a COLMAP model that pycolmap can read"),
        ("cameras.txt", "1 PINHOLE\n", "is not a COLMAP model that pycolmap can read"),
        ("images.txt", "text\n\n", "images.txt, line 1: is neither an image 'IMAGE_ID QW"),
    ],
)
def test_a_damaged_text_model_is_named_in_one_line(yard, file, line, says):
    write_model(yard / "sparse", binary=False)
    (yard / "sparse" / file).write_text(line)
    with pytest.raises(InputError) as caught:
        read(yard)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_count_that_lies_costs_no_memory(yard):
    write_model(yard / "sparse/0", binary=True)
    file = yard / "sparse/0" / "points3D.bin"
    whole = file.read_bytes()
    for place in (0, 8 + 43):  # of the points, and of the first one's track
        file.write_bytes(whole[:place] + b"\xff" * 7 + whole[place + 7 :])
        with (
            mock.patch("pycolmap.Reconstruction", side_effect=AssertionError("COLMAP would believe the count")),
            pytest.raises(InputError, match=r"points3D\.bin: is truncated"),
        ):
            read(yard)


def test_without_pycolmap_the_extra_is_named(yard, monkeypatch):
    (yard / "sparse").mkdir()
    (yard / "sparse" / "images.txt").touch()
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install 'mambaloc\[colmap\]'"):
        read(yard)
    assert colmap.colmap_folder(yard) == yard / "sparse"
