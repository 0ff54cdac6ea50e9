"""Intrinsics of each dataset's frames."""

import json

import cv2
import numpy as np
import pytest

from mambaloc.data.cameras import frame_intrinsics, known_or_assumed_cameras
from mambaloc.data.datasets import capture, seven_scenes
from mambaloc.data.datasets.capture import COLUMNS
from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError, InputWarning
from mambaloc.rendering import default_intrinsics


def test_7scenes_has_one_color_camera(write_tiny_scene):
    """525 px at a width of 640, the centre in the middle of the image: here 32x24."""
    folder = write_tiny_scene({1: 3}).folder
    frames = seven_scenes.read_split(folder, "train", BadFrames())
    expected = [[26.25, 0, 15.5], [0, 26.25, 11.5], [0, 0, 1]]
    np.testing.assert_allclose(frame_intrinsics("7scenes", folder, frames), [expected] * 3)


def test_a_rendered_scene_says_its_camera(scenes):
    frames = seven_scenes.read_split(scenes / "heads", "test", BadFrames())
    found = frame_intrinsics("7scenes", scenes / "heads", frames)
    np.testing.assert_allclose(found, np.repeat(default_intrinsics((96, 72))[None], 8, axis=0))


SKEWED, FLAT = ([[9, 1, 4], [0, 9, 3], [0, 0, 1]], [[0, 0, 4], [0, 9, 3], [0, 0, 1]])


@pytest.mark.parametrize("told", [None, 5, "wide", [[1, 0], [0, 1]], FLAT, SKEWED, [["a"] * 3] * 3])
def test_a_rendering_of_a_malformed_camera_is_refused(write_tiny_scene, told):
    folder = write_tiny_scene({1: 3}).folder
    (folder / "scene.json").write_text(json.dumps({"intrinsics_px": told}))
    with pytest.raises(InputError, match=r"scene\.json: intrinsics_px must be a 3x3 matrix") as caught:
        known_or_assumed_cameras("7scenes", folder, seven_scenes.read_split(folder, "train", BadFrames()))
    assert "\n" not in str(caught.value)


def test_where_cameras_are_unknown_a_usual_one_is_assumed_but_no_map_is_made(write_tiny_scene):
    folder = write_tiny_scene({1: 3}).folder
    frames = seven_scenes.read_split(folder, "train", BadFrames())
    with pytest.raises(InputError, match=r"has no cameras: neither .* Add such a file"):
        frame_intrinsics("cambridge", folder, frames)
    with pytest.warns(InputWarning, match=r"den: has no cameras.* 0\.87 of .* longer side is assumed") as said:
        cameras = known_or_assumed_cameras("cambridge", folder, frames)
    assert "\n" not in str(said[0].message)
    np.testing.assert_allclose(cameras.intrinsics, [[[0.87 * 32, 0, 15.5], [0, 0.87 * 32, 11.5], [0, 0, 1]]] * 3)
    assert cameras.describe() == {"focal_ratio": 0.87, "assumed": True}


@pytest.fixture
def imported(tmp_path):
    """Three frames of two cameras."""
    cameras = ("a", "b", "a")
    rows = [f"{i}.png,walk,{i},0,0,{i},1,0,0,0,{camera},train" for i, camera in enumerate(cameras)]
    (tmp_path / "frames.csv").write_text("\n".join([",".join(COLUMNS), *rows]) + "\n")
    for i in range(3):
        (tmp_path / f"{i}.png").write_bytes(b"")
    note = {
        "mambaloc_scene": 1,
        "cameras": {
            "a": {"width": 32, "height": 24, "focal_px": [28.0, 29.0], "centre_px": [15.0, 11.0]},
            "b": {"width": 64, "height": 48, "focal_px": [50.0, 50.0], "centre_px": [31.5, 23.5]},
        },
    }
    (tmp_path / "scene.json").write_text(json.dumps(note))
    return tmp_path


def cameras_of(scene, split="train"):
    return known_or_assumed_cameras("capture", scene, capture.read_split(scene, split, BadFrames()))


def with_cameras(scene, cameras):
    note = json.loads((scene / "scene.json").read_text())
    (scene / "scene.json").write_text(json.dumps({**note, "cameras": cameras}))


def test_an_imported_scene_has_a_camera_a_frame(imported):
    a, b = [[28.0, 0, 15], [0, 29, 11], [0, 0, 1]], [[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]]
    found = cameras_of(imported)
    np.testing.assert_array_equal(found.intrinsics, [a, b, a])
    np.testing.assert_array_equal(found.size_px, [[32, 24], [64, 48], [32, 24]])
    assert found.describe() == {"focal_ratio": 0.875, "assumed": False}


@pytest.mark.parametrize("cameras", [None, {}, {"a": {}, "b": {}}, {"a": {"focal_px": [1, 1]}}, []])
def test_of_an_imported_scene_without_cameras_a_usual_one_is_assumed(imported, cameras):
    with_cameras(imported, cameras)
    frames = capture.read_split(imported, "train", BadFrames())
    with pytest.raises(InputError, match=r"has no focal length and centre of camera '[ab]'\. Import the scene with"):
        frame_intrinsics("capture", imported, frames)
    for image in frames.image_paths:
        cv2.imwrite(str(image), np.zeros((40, 20, 3), np.uint8))
    with pytest.warns(InputWarning, match=r"scene\.json: has no focal length .* A focal length of 0\.87 .* is assumed"):
        found = known_or_assumed_cameras("capture", imported, frames)
    np.testing.assert_allclose(found.intrinsics, [[[0.87 * 40, 0, 9.5], [0, 0.87 * 40, 19.5], [0, 0, 1]]] * 3)
    assert found.is_assumed


GOOD = {"width": 32, "height": 24, "focal_px": [28.0, 29.0], "centre_px": [15.0, 11.0]}


@pytest.mark.parametrize(
    "camera",
    [
        5,
        {**GOOD, "focal_px": [1.0]},
        {**GOOD, "focal_px": 3},
        {**GOOD, "focal_px": [-28, 28]},
        {**GOOD, "focal_px": [1e999, 28]},
        {**GOOD, "centre_px": "xy"},
        {**GOOD, "width": None},
        {**GOOD, "height": 1e12},
        {**GOOD, "height": 0},
        {key: GOOD[key] for key in ("focal_px", "centre_px")},
    ],
)
def test_a_malformed_camera_is_refused(imported, camera):
    with_cameras(imported, {"a": camera, "b": GOOD})
    with pytest.raises(InputError, match=r"scene\.json: camera 'a' must have 'width' and 'height'") as caught:
        cameras_of(imported)
    assert "\n" not in str(caught.value)
