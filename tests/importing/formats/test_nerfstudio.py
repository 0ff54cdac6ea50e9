"""``transforms.json``: poses and cameras as they were meant, and every bad input named."""

from __future__ import annotations

import json
import math
import re

import cv2
import numpy as np
import pytest
from captures import FLIP
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.importing.registry import read_capture
from mambaloc.importing.undistort.fitting import fitted

WIDTH, HEIGHT = 32, 24


@pytest.fixture
def write(tmp_path):
    """Write a capture of tiny images; ``told`` goes beside its frames, ``frame`` into each."""

    def write(names=("images/a_1.png", "images/a_2.png"), absent=(), frame=None, file="transforms.json", **told):
        rng = np.random.default_rng(5)
        poses = np.tile(np.eye(4), (len(names), 1, 1))
        poses[:, :3, :3] = Rotation.from_quat(rng.normal(size=(len(names), 4))).as_matrix()
        poses[:, :3, 3] = rng.uniform(-3, 3, (len(names), 3))
        frames = []
        for name, pose in zip(names, poses, strict=True):
            if name not in absent:
                path = tmp_path / (name if name.endswith((".png", ".JPG")) else f"{name}.png")
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
            frames.append({"file_path": name, "transform_matrix": pose.tolist(), **(frame or {})})
        (tmp_path / file).write_text(json.dumps({"frames": frames, **told}))
        return poses

    return write


FOCAL = {"fl_x": 30.0, "fl_y": 31.0, "cx": 16.0, "cy": 12.5, "w": WIDTH, "h": HEIGHT}


def test_poses_are_turned_to_opencvs_axes(write, tmp_path):
    poses = write()
    capture = read_capture(tmp_path)
    assert capture.kind == "nerfstudio"
    assert capture.unit == "unknown"
    np.testing.assert_allclose(capture.world_from_cam[:, :3, 3], poses[:, :3, 3])
    for found, pose in zip(capture.world_from_cam, poses, strict=True):
        right, up, back = pose[:3, :3].T
        np.testing.assert_allclose(found[:3, :3].T, (right, -up, -back))


def test_what_was_applied_is_undone(write, tmp_path):
    """nerfstudio scales what it has turned: file = scale * (turn @ original)."""
    turn = np.eye(4)
    turn[:3] = np.array([[1.0, 0, 0, 0.5], [0, 0, 1, -2], [0, -1, 0, 1]])
    poses = write(applied_transform=turn[:3].tolist(), applied_scale=0.25)
    capture = read_capture(tmp_path)
    for found, pose in zip(capture.world_from_cam, poses, strict=True):
        again = turn @ found
        again[:3, 3] *= 0.25
        np.testing.assert_allclose(again @ FLIP, pose, atol=1e-12)
    assert "applied_transform and applied_scale undone" in capture.choices["world"]


def test_three_rows_are_enough(write, tmp_path):
    write()
    told = json.loads((tmp_path / "transforms.json").read_text())
    whole = read_capture(tmp_path).world_from_cam
    for frame in told["frames"]:
        del frame["transform_matrix"][3]
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    np.testing.assert_array_equal(read_capture(tmp_path).world_from_cam, whole)


_BY_COLUMN = "written column after column: only so are they rotations"
WRITTEN = {
    "2 in one list of numbers": lambda pose: pose.ravel(),
    "2 in one list of numbers ": lambda pose: pose[:3].ravel(),
    _BY_COLUMN: lambda pose: pose.T,
    f"2 in one list of numbers; {_BY_COLUMN}": lambda pose: pose.T.ravel(),
    f"2 in one list of numbers; {_BY_COLUMN} ": lambda pose: pose[:3].T.ravel(),
}


@pytest.mark.parametrize(("said", "numbers"), WRITTEN.items())
def test_numbers_in_one_list_or_column_after_column(write, tmp_path, said, numbers):
    poses = write()
    told = json.loads((tmp_path / "transforms.json").read_text())
    for frame, pose in zip(told["frames"], poses, strict=True):
        frame["transform_matrix"] = numbers(pose).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    capture = read_capture(tmp_path)
    np.testing.assert_allclose(capture.world_from_cam, poses @ FLIP, atol=1e-12)
    assert capture.choices["matrices"] == said.strip()


def test_frames_come_by_number_sequence_after_sequence(write, tmp_path):
    names = ["b/f10.png", "b/f9.png", "a/f2.png", "a/f1.png", "a/x/f3.png", "a/f10.png"]
    write(names)
    capture = read_capture(tmp_path / "transforms.json")
    found = [path.relative_to(tmp_path).as_posix() for path in capture.images]
    assert found == ["a/f1.png", "a/f2.png", "a/f10.png", "a/x/f3.png", "b/f9.png", "b/f10.png"]
    assert capture.sequences == ("a", "a", "a", "a/x", "b", "b")


def test_names_without_suffix_missing_images_and_images_beside(write, tmp_path):
    write(["./images/1", "images/2", "images/3.JPG", "images/4.png"], absent=["images/2", "images/4.png"])
    cv2.imwrite(str(tmp_path / "images/extra.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    capture = read_capture(tmp_path)
    assert [path.name for path in capture.images] == ["1.png", "3.JPG"]
    assert capture.poses_without_image == ("images/2", "images/4.png")
    assert [path.name for path in capture.images_without_pose] == ["extra.png"]


def test_one_camera_for_all(write, tmp_path):
    write(**FOCAL)
    capture = read_capture(tmp_path)
    (camera,) = capture.cameras.values()
    assert capture.camera_of == ("camera-1", "camera-1")
    assert (camera.width, camera.height, camera.focal_px) == (WIDTH, HEIGHT, (30.0, 31.0))
    assert camera.center_px == (15.5, 12.0)  # pixels counted from the corner become pixels counted from a centre
    assert camera.distorted is None
    assert camera.model == "PINHOLE"


def test_a_frames_own_camera_comes_before_the_files(write, tmp_path):
    write(**FOCAL)
    told = json.loads((tmp_path / "transforms.json").read_text())
    told["frames"][1]["fl_x"] = 40.0
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    capture = read_capture(tmp_path)
    assert [capture.cameras[name].focal_px for name in capture.camera_of] == [(30.0, 31.0), (40.0, 31.0)]


def test_an_angle_of_view_alone(write, tmp_path):
    write(camera_angle_x=0.9)
    (camera,) = read_capture(tmp_path).cameras.values()
    assert camera.focal_px == (pytest.approx(WIDTH / 2 / math.tan(0.45)),) * 2
    assert camera.center_px == ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def test_no_camera_at_all(write, tmp_path):
    write()
    capture = read_capture(tmp_path)
    assert (capture.cameras, capture.camera_of) == ({}, None)


def test_smaller_images_than_the_file_speaks_of(write, tmp_path):
    write(**{**FOCAL, "fl_x": 60.0, "fl_y": 62.0, "cx": 32.0, "cy": 25.0, "w": 2 * WIDTH, "h": 2 * HEIGHT}, k1=0.1)
    capture = read_capture(tmp_path)
    (told,) = capture.cameras.values()
    camera = fitted(told, (WIDTH, HEIGHT))
    assert (camera.width, camera.height, camera.focal_px, camera.center_px) == (
        WIDTH,
        HEIGHT,
        (30.0, 31.0),
        (15.5, 12.0),
    )
    (at_axis,) = camera.distorted(np.zeros((1, 2)))
    np.testing.assert_allclose(at_axis, (15.5, 12.0))


@pytest.mark.parametrize("told", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_a_fisheye(write, tmp_path, told):
    write(**FOCAL, **told, k1=0.1, k2=0.02, k3=0.0, k4=0.01)
    (camera,) = read_capture(tmp_path).cameras.values()
    matrix = np.array([[30.0, 0, 15.5], [0, 31.0, 12.0], [0, 0, 1]])
    rays = np.array([[[0.4, -0.3]]])
    expected = cv2.fisheye.distortPoints(rays, matrix, np.array([0.1, 0.02, 0.0, 0.01]))[0]
    np.testing.assert_allclose(camera.distorted(rays[0]), expected, atol=1e-9)
    assert camera.model == "OPENCV_FISHEYE"


@pytest.mark.parametrize("told", [{"camera_model": "OPENCV"}, {}])
def test_a_lens(write, tmp_path, told):
    write(**FOCAL, **told, k1=0.1, k2=0.02, k3=0.3, p1=0.01, p2=-0.02)
    (camera,) = read_capture(tmp_path).cameras.values()
    matrix = np.array([[30.0, 0, 15.5], [0, 31.0, 12.0], [0, 0, 1]])
    point = np.array([[0.4, -0.3, 1.0]])
    expected = cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, np.array([0.1, 0.02, 0.01, -0.02, 0.3]))[0][0]
    np.testing.assert_allclose(camera.distorted(point[:, :2]), expected)


def test_nerfs_three_files_are_three_splits(write, tmp_path):
    write(["./train/r_0", "./train/r_1"], file="transforms_train.json", camera_angle_x=0.9)
    write(["./test/r_0"], file="transforms_test.json", camera_angle_x=0.9)
    capture = read_capture(tmp_path)
    assert capture.split == ("test", "train", "train")
    assert len(capture.cameras) == 1


def test_splits_by_name(write, tmp_path):
    names = ["i/1.png", "i/2.png", "i/3.png"]
    write(names, train_filenames=names[:1], test_filenames=["./i/3.png"])
    assert read_capture(tmp_path).split == ("train", "unused", "test")


@pytest.mark.parametrize(
    ("lists", "split", "said"),
    [
        ({"train": ["1.png"], "test": ["3.png"]}, ("train", "unused", "test"), None),
        ({"train": ["C:\\scan\\i\\1.png"], "test": ["./i/3"]}, ("train", "unused", "test"), None),
        (
            {"train": ["i/1.png", "i/2.png"], "val": ["i/3.png"]},
            ("train", "train", "test"),
            "the validation frames are",
        ),
        ({"train": ["1.png"], "val": ["3.png"], "test": ["3.png"]}, ("train", "unused", "test"), "1 names are in more"),
        (
            {"train": ["1.png", "9.png"], "test": ["2.png", "../a"]},
            ("train", "test", "unused"),
            "2 listed names are of no",
        ),
    ],
)
def test_lists_name_frames_as_programs_write_them(write, tmp_path, lists, split, said):
    write(["i/1.png", "i/2.png", "i/3.png"], **{f"{name}_filenames": names for name, names in lists.items()})
    capture = read_capture(tmp_path)
    assert capture.split == split
    assert capture.choices.get("split", "").startswith(said or "")
    assert ("split" in capture.choices) == (said is not None)
    assert ("'9.png' is listed, 'i/1.png' is a frame" in capture.split_concern) == ("9.png" in lists["train"])


def test_lists_that_name_no_frame_are_stated_with_a_name_of_each_side(write, tmp_path):
    write(["i/1.png", "i/2.png"], train_filenames=["cam1/a.png"], test_filenames=["cam1/b.png"])
    capture = read_capture(tmp_path)
    said = "lists of names that are of none of its frames ('cam1/a.png' is listed, 'i/1.png' is a frame)"
    assert (capture.split, capture.split_concern) == (None, said)


def test_a_listed_name_of_two_frames_is_neither(write, tmp_path):
    write(["i/1.png", "j/1.png", "j/2.png"], train_filenames=["1.png", "j/2.png"])
    capture = read_capture(tmp_path)
    assert capture.split == ("unused", "unused", "train")
    assert capture.choices["split"] == "1 listed names are of no frame, or of several: 1.png"


def test_a_frame_without_a_matrix_has_no_pose(write, tmp_path):
    write(frame={"transform_matrix": None})
    assert np.isnan(read_capture(tmp_path).world_from_cam[:, :3]).all()


def test_a_split_of_images_that_are_not_there_is_none(write, tmp_path):
    names = ("images/a_1.png", "images/a_2.png")
    write(names, absent=names[:1], train_filenames=names[:1])
    capture = read_capture(tmp_path)
    assert capture.split is None
    assert capture.split_concern.startswith("a split of its own that names none of the frames")


def test_a_pose_that_is_not_known_stays_for_the_checks(write, tmp_path):
    write(frame={"transform_matrix": [[math.nan] * 4] * 4})
    assert np.isnan(read_capture(tmp_path).world_from_cam[:, :3]).all()


def frame(key, value):
    """Change the first frame."""
    return lambda told: {**told, "frames": [{**told["frames"][0], key: value}, *told["frames"][1:]]}


def top(**values):
    """Change what holds for all frames."""
    return lambda told: {**told, **values}


def without(told, *keys):
    return {key: value for key, value in told.items() if key not in keys}


BAD = {
    "is not JSON": lambda told: "{",
    "is not JSON ": lambda told: "[" * 100_000,
    "has no list of 'frames'": lambda told: {},
    "is not a JSON object; it holds 'frames'": lambda told: [],
    "has no list of 'frames' ": top(frames=[1]),
    "frame 1: file_path: names 'None', which is not a file inside": frame("file_path", None),
    "frame 1: file_path: names '../../secret.png', which is not a file inside": frame("file_path", "../../secret.png"),
    "frame 1: file_path: names '/etc/passwd', which is not a file inside": frame("file_path", "/etc/passwd"),
    "frame 1: file_path: names 'C:\\\\a.png', which is not a file inside": frame("file_path", "C:\\a.png"),
    "aaaaaa', which is not a file inside": frame("file_path", "a" * 253),  # too long with a suffix
    "images/a_2.png more than one pose; remove all but one": frame("file_path", "images/a_2.png"),
    "some frames have a focal length": lambda told: frame("fl_x", 30.0)(without(told, "fl_x")),
    "camera of a_1.png: fl_x is 'wide', not a finite number": frame("fl_x", "wide"),
    "camera of a_1.png: fl_x is 'nan', not a finite number": frame("fl_x", math.nan),
    "camera of a_1.png: k1 is 'True', not a finite number": frame("k1", True),
    "focal length -5: correct it": frame("fl_x", -5),
    "1e+09x24 pixels": frame("w", 1e9),
    "32767x24 pixels": frame("w", 32767),
    "is far outside the image": frame("cx", 1e6),
    "camera_angle_x is 4": lambda told: top(camera_angle_x=4)(without(told, "fl_x", "fl_y")),
    "camera_model 'EQUIRECTANGULAR' is not read": frame("camera_model", "EQUIRECTANGULAR"),
    "k4 is 0.1, which OpenCV's lens does not have": frame("k4", 0.1),
    "applied_scale is 0": top(applied_scale=0),
    "applied_transform is not a rotation and translation": top(applied_transform=[[2, 0, 0, 0]] * 3),
    "applied_transform is not a 4x4": top(applied_transform="z up"),
    "train_filenames is not a list": top(train_filenames=3),
}


MALFORMED = {
    "frame 1: transform_matrix is not a 4x4 or 3x4 matrix": [[1, 2], [3, 4]],
    "frame 1: transform_matrix is not a 4x4 or 3x4 matrix ": "none",
    "frame 1: transform_matrix is not a 4x4 or 3x4 matrix  ": [["a"] * 4] * 4,
    "frame 1: transform_matrix's last row is not 0 0 0 1": [[1, 0, 0, 0]] * 4,
}


@pytest.mark.parametrize(("message", "matrix"), MALFORMED.items())
def test_a_malformed_matrix_leaves_its_frame_out_and_all_of_them_are_refused(write, tmp_path, message, matrix):
    write(**FOCAL)
    whole = read_capture(tmp_path)
    file = tmp_path / "transforms.json"
    told = json.loads(file.read_text())
    told["frames"][0]["transform_matrix"] = matrix
    file.write_text(json.dumps(told))
    capture = read_capture(tmp_path)
    np.testing.assert_array_equal(capture.world_from_cam, whole.world_from_cam[1:])
    ((name, rule),) = capture.left_out.items()
    assert name == str(tmp_path / "images/a_1.png")
    assert message.strip() in rule
    for each in told["frames"]:
        each["transform_matrix"] = matrix
    file.write_text(json.dumps(told))
    with pytest.raises(InputError, match=re.escape(message.strip())):
        read_capture(tmp_path)


@pytest.mark.parametrize(("message", "change"), BAD.items())
def test_bad_input_is_named_in_one_line(write, tmp_path, message, change):
    write(**FOCAL)
    file = tmp_path / "transforms.json"
    told = change(json.loads(file.read_text()))
    file.write_text(told if isinstance(told, str) else json.dumps(told))
    with pytest.raises(InputError, match=re.escape(message.strip())) as caught:
        read_capture(tmp_path, "nerfstudio")
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_no_image_is_there(write, tmp_path):
    write(absent=("images/a_1.png", "images/a_2.png"))
    with pytest.raises(InputError, match=r"no image with a pose; 2 are named and missing, such as 'images/a_1\.png'"):
        read_capture(tmp_path)


def test_more_frames_than_a_scene_may_have(write, tmp_path, monkeypatch):
    write()
    monkeypatch.setattr("mambaloc.importing.formats.builder.MAX_FRAMES", 1)
    with pytest.raises(InputError, match="lists 2 frames, more than 1; keep fewer"):
        read_capture(tmp_path)


def test_no_image_can_be_decoded(write, tmp_path):
    write(**{key: value for key, value in FOCAL.items() if key not in "wh"})
    for path in (tmp_path / "images").iterdir():
        path.write_bytes(b"no image")
    with pytest.raises(InputError, match="neither it nor any other of 2 images can be decoded"):
        read_capture(tmp_path)


def test_a_folder_of_something_else(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match="the format is not recognized"):
        read_capture(tmp_path)
    with pytest.raises(InputError, match=r"contains none of transforms\.json"):
        read_capture(tmp_path, "nerfstudio")
