"""COLMAP models written by pycolmap: poses exactly, each camera model's pixels, every damage named in one line."""

from __future__ import annotations

import json
import math
from unittest import mock

import cv2
import numpy as np
import pytest
from colmap_models import MODELS, NAMES, pycolmap, write_model
from recorded import FRAMES, SIZE

from mambaloc.data.cameras import undistortion_of
from mambaloc.importing.formats.colmap import read_colmap
from mambaloc.importing.importer import import_scene
from mambaloc.importing.registry import read_capture
from mambaloc.runtime.camera_models import CameraModel


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(("model", "images"), [("sparse/0", "images"), ("sparse", "."), (".", "."), (".", "images")])
def test_a_model_is_read_back(recording, tmp_path, binary, model, images):
    write_model(recording, tmp_path / model, binary)
    recording.write(tmp_path / images, NAMES)
    (tmp_path / images / "run" / "12.jpg").write_bytes(recording.jpegs[0])
    capture = read_capture(tmp_path)
    order = [3, 4, 5, 0, 1, 2]  # run before walk, 9 before 10
    assert (capture.kind, capture.unit) == ("colmap", "unknown")
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam[order], atol=1e-12)
    assert [path.read_bytes() for path in capture.images] == [recording.jpegs[k] for k in order]
    assert capture.sequences == ("run",) * 3 + ("walk",) * 3
    assert capture.camera_of == ("camera-1",) * FRAMES
    assert capture.images_without_pose == (tmp_path / images / "run" / "12.jpg",)
    camera = capture.cameras["camera-1"]
    assert (camera.width, camera.height, camera.focal_px, camera.center_px) == (*SIZE, (60, 60), (32.5, 24.5))


def test_points_are_read_with_their_tracks(recording, tmp_path):
    """The point of the model, seen by its first two images at pixel (3, 4) from the corner, against OpenCV."""
    write_model(recording, tmp_path, models=("OPENCV",))
    recording.write(tmp_path, NAMES)
    tracks = read_capture(tmp_path).tracks
    fx, fy, cx, cy, *lens = MODELS["OPENCV"]
    ray = cv2.undistortPoints(np.array([[[3.0, 4.0]]]), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(lens))
    assert tracks.points_m.tolist() == [[1, 2, 3]]
    assert (tracks.point.tolist(), tracks.frame.tolist()) == ([0, 0], [3, 4])  # run before walk
    np.testing.assert_allclose(tracks.rays, [ray[0, 0]] * 2, atol=1e-3)


def test_a_model_without_points_has_no_tracks(recording, tmp_path):
    write_model(recording, tmp_path, points=False)
    recording.write(tmp_path, NAMES)
    assert read_capture(tmp_path).tracks is None


@pytest.mark.parametrize("model", ["sparse/0", "sparse"])
def test_images_are_found_from_the_models_own_folder(recording, tmp_path, model):
    write_model(recording, tmp_path / model)
    images = recording.write(tmp_path / "images", NAMES)
    images[1].unlink()
    capture = read_capture(tmp_path / model)
    assert set(capture.images) == set(images) - {images[1]}
    assert capture.poses_without_image == ("walk/1.jpg",)


def oracle(model, rays):
    """Pixels from the centre of the top-left one, by OpenCV or by the formula in COLMAP's documentation."""
    params = MODELS[model]
    one_focal = model.startswith(("SIMPLE", "RADIAL"))
    fx, fy = (params[0], params[0]) if one_focal else params[:2]
    cx, cy, *extra = params[1:] if one_focal else params[2:]
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    points = np.column_stack([rays, np.ones(len(rays))])
    if model == "FOV":
        radius = np.linalg.norm(rays, axis=1)
        factor = np.arctan(2 * radius * math.tan(extra[0] / 2)) / (radius * extra[0])
        return rays * factor[:, None] * (fx, fy) + (cx - 0.5, cy - 0.5)
    if "FISHEYE" in model:
        k = np.array([*extra, 0, 0, 0][:4]) if model != "OPENCV_FISHEYE" else np.array(extra)
        return cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), matrix, k)[0][0]
    order = {
        "SIMPLE_RADIAL": [*extra, 0, 0, 0],
        "RADIAL": [*extra, 0, 0],
        "SIMPLE_PINHOLE": [0] * 4,
        "PINHOLE": [0] * 4,
    }
    k = np.array(order.get(model, extra), dtype=float)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, k)[0][:, 0]


@pytest.mark.parametrize("model", [name for name in MODELS if name != "THIN_PRISM_FISHEYE"])
def test_pixels_are_those_of_an_independent_projection(recording, tmp_path, model):
    write_model(recording, tmp_path, models=(model,))
    recording.write(tmp_path, NAMES)
    camera = read_colmap(tmp_path).cameras["camera-1"]
    rays = np.random.default_rng(0).uniform(-0.45, 0.45, (50, 2))
    assert camera.model == model
    if "PINHOLE" in model:
        assert camera.distorted is None
        pixels = rays * camera.focal_px + np.array(camera.center_px)
    else:
        pixels = camera.distorted(rays)
        assert np.abs(pixels - rays * camera.focal_px - camera.center_px).max() > 0.1  # it does distort
    np.testing.assert_allclose(pixels, oracle(model, rays), atol=1e-6)
    assert isinstance(camera.distorted, CameraModel) == (model not in ("PINHOLE", "SIMPLE_PINHOLE", "FOV"))


def test_a_lens_that_is_none_of_opencvs_is_not_kept_and_the_scene_says_why(recording, tmp_path):
    write_model(recording, tmp_path / "capture", models=("FOV",))
    recording.write(tmp_path / "capture", NAMES)
    import_scene(tmp_path / "capture", tmp_path / "scene")
    lens = json.loads((tmp_path / "scene/scene.json").read_text())["cameras"]["camera-1"]["lens"]
    assert (lens["model"], lens["opencv"]) == ("FOV", None)
    frames = tmp_path / "scene/frames.csv"  # six frames are too few to split
    frames.write_text(frames.read_text().replace(",unused", ",train"))
    assert undistortion_of(tmp_path / "scene").unknown == "its model, FOV, is not one of OpenCV's"


def test_a_thin_prism_is_pycolmaps(recording, tmp_path):
    write_model(recording, tmp_path, models=("THIN_PRISM_FISHEYE",))
    recording.write(tmp_path, NAMES)
    camera = read_colmap(tmp_path).cameras["camera-1"]
    there = pycolmap.Camera(model="THIN_PRISM_FISHEYE", width=64, height=48, params=MODELS["THIN_PRISM_FISHEYE"])
    for ray in ((0.1, 0.2), (-0.4, 0.3)):
        expected = there.img_from_cam(np.array([*ray, 1.0])) - 0.5
        np.testing.assert_allclose(camera.distorted(np.array([ray]))[0], expected, atol=1e-12)


def test_several_cameras_are_told_apart(recording, tmp_path):
    write_model(recording, tmp_path, models=("PINHOLE", "OPENCV", "OPENCV_FISHEYE"))
    recording.write(tmp_path, NAMES)
    capture = read_colmap(tmp_path)
    assert {name: camera.model for name, camera in capture.cameras.items()} == {
        "camera-1": "PINHOLE",
        "camera-2": "OPENCV",
        "camera-3": "OPENCV_FISHEYE",
    }
    assert capture.camera_of == ("camera-1", "camera-2", "camera-3") * 2


@pytest.mark.parametrize("names", [["../a.jpg"], ["/a.jpg"], ["C:/a.jpg"], ["walk/../../a.jpg"]])
def test_names_that_lead_out_are_refused(recording, tmp_path, refused, names):
    write_model(recording, tmp_path / "sparse", names=names + NAMES[1:])
    recording.write(tmp_path / "images", NAMES)
    refused(read_colmap, tmp_path, "which is not a file inside")


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "frames.bin", "points3D.bin", "rigs.bin"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_cut_file_is_named_in_one_line(recording, tmp_path, refused, file, share):
    write_model(recording, tmp_path)
    recording.write(tmp_path, NAMES)
    whole = (tmp_path / file).read_bytes()
    (tmp_path / file).write_bytes(whole[: int(share * len(whole))])
    with mock.patch("pycolmap.Reconstruction", side_effect=AssertionError("COLMAP would read past the end")):
        refused(read_colmap, tmp_path, f"{file}: is truncated")


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("cameras.txt", " 60 33", " nan 33", ""),
        ("cameras.txt", " 60 33", " 0 33", "without a size or a finite, positive focal length"),
        ("cameras.txt", " 64 48 ", " 0 48 ", "without a size or a finite, positive focal length"),
        ("cameras.txt", " 64 48 ", " 40000 48 ", "a camera has 40000x48 pixels, more than 32766 a side"),
        ("cameras.txt", "SIMPLE_RADIAL", "ROUND", "is not a COLMAP model that pycolmap can read"),
    ],
)
def test_a_damaged_text_is_named_in_one_line(recording, tmp_path, refused, file, old, new, says):
    write_model(recording, tmp_path, binary=False)
    recording.write(tmp_path, NAMES)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    refused(read_colmap, tmp_path, says, str(tmp_path))


def test_a_model_without_its_images(recording, tmp_path, refused):
    write_model(recording, tmp_path / "sparse")
    refused(read_colmap, tmp_path, "6 are named and missing, such as 'run/9.jpg'")
    refused(read_colmap, tmp_path / "sparse" / "none", "contains no COLMAP model")


def test_without_pycolmap_the_extra_is_named(recording, tmp_path, refused, monkeypatch):
    write_model(recording, tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    refused(read_capture, tmp_path, "pip install 'mambaloc[colmap]'")


# What our reader makes up for in pycolmap 4.2.1. If one of these fails after an upgrade, look at what it says.


def test_pycolmap_gives_the_last_image_first(recording, tmp_path):
    """Guess: ``Reconstruction.images`` is in the order of numbers, as a dict. It is a hash map's: last one first."""
    write_model(recording, tmp_path)
    images = pycolmap.Reconstruction(str(tmp_path)).images
    assert [*images] == [6, 5, 4, 3, 2, 1]  # our reader sorts by name: test_a_model_is_read_back above


def test_pycolmap_cuts_names_at_the_first_space(recording, tmp_path):
    """Guess: the name is the rest of its line. It is one word, without an error; our reader gives the whole name."""
    names = [f"hall way/{k} left.jpg" for k in range(FRAMES)]
    write_model(recording, tmp_path, binary=False, names=names)
    recording.write(tmp_path / "images", names)
    assert {image.name for image in pycolmap.Reconstruction(str(tmp_path)).images.values()} == {"hall"}
    capture = read_capture(tmp_path)
    assert [image.relative_to(tmp_path / "images").as_posix() for image in capture.images] == names
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-6)
