"""Intrinsics of each dataset's frames."""

import json

import numpy as np
import pytest

from mambaloc.data.cameras import frame_intrinsics
from mambaloc.data.datasets import capture, seven_scenes
from mambaloc.data.datasets.capture import COLUMNS
from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError
from mambaloc.rendering import default_intrinsics


def test_7scenes_has_one_colour_camera(write_tiny_scene):
    """525 px at a width of 640, the centre in the middle of the picture: here 32x24."""
    folder = write_tiny_scene({1: 3}).folder
    frames = seven_scenes.read_split(folder, "train", BadFrames())
    expected = [[26.25, 0, 15.5], [0, 26.25, 11.5], [0, 0, 1]]
    np.testing.assert_allclose(frame_intrinsics("7scenes", folder, frames), [expected] * 3)


def test_a_rendered_scene_says_its_camera(scenes):
    frames = seven_scenes.read_split(scenes / "heads", "test", BadFrames())
    found = frame_intrinsics("7scenes", scenes / "heads", frames)
    np.testing.assert_allclose(found, np.repeat(default_intrinsics((96, 72))[None], 8, axis=0))


def test_cameras_of_other_datasets_are_refused(write_tiny_scene):
    folder = write_tiny_scene({1: 3}).folder
    frames = seven_scenes.read_split(folder, "train", BadFrames())
    with pytest.raises(InputError, match=r"cameras of cambridge are not read yet\. Import it"):
        frame_intrinsics("cambridge", folder, frames)


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


def test_an_imported_scene_has_a_camera_a_frame(imported):
    found = frame_intrinsics("capture", imported, capture.read_split(imported, "train", BadFrames()))
    a, b = [[28.0, 0, 15], [0, 29, 11], [0, 0, 1]], [[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]]
    np.testing.assert_array_equal(found, [a, b, a])


@pytest.mark.parametrize(
    "cameras",
    [None, {}, {"a": {}}, {"a": {"focal_px": [1.0], "centre_px": [1, 2]}}, {"a": {"focal_px": 3, "centre_px": "x"}}],
)
def test_an_imported_scene_without_cameras_is_refused(imported, cameras):
    frames = capture.read_split(imported, "train", BadFrames())
    note = json.loads((imported / "scene.json").read_text())
    (imported / "scene.json").write_text(json.dumps({**note, "cameras": cameras}))
    with pytest.raises(InputError, match=r"does not say focal length and centre of camera '[ab]'"):
        frame_intrinsics("capture", imported, frames)
