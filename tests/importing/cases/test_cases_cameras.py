"""Real captures whose cameras, images, paths or models were read wrongly or refused once: each as its truth says."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import tool
from reading_truth import CASES, assert_true, needs_cases, scene_poses, true_poses

from mambaloc.data.cameras import frame_intrinsics
from mambaloc.data.datasets.capture import read_rows, read_split
from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError
from mambaloc.importing.importer import import_scene
from mambaloc.importing.registry import read_capture

pytestmark = needs_cases

FOCAL = 144 / 160  # of each image's width, in all cases


@pytest.fixture
def imported(tmp_path):
    """Import a case, check poses against the truth, and images against poses; return what ``scene.json`` says."""

    def imported(source: str, without: tuple[str, ...] = (), images: str | None = None):
        scene = tmp_path / "scene"
        import_scene(CASES / source, scene, images=None if images is None else CASES / images)
        said = json.loads((scene / "scene.json").read_text())
        truth = true_poses(CASES / source.split("/")[0] / "truth.txt")
        assert_true(scene_poses(scene), {_safe(name): pose for name, pose in truth.items() if name not in without})
        assert said["sanity"]["checks"]["images and poses"]["share"]["as they were read"] > 0.7
        assert abs(said["sanity"]["checks"]["focal length"]["best_over_given"] - 1) < 0.03
        return said

    return imported


def _safe(name: str) -> str:
    """How an imported scene spells an image's name."""
    return f"{re.sub(r'[^a-z0-9.-]+', '_', Path(name).stem.lower()).strip('_')}{Path(name).suffix}"


def sizes(said) -> set[tuple[int, int]]:
    return {(camera["width"], camera["height"]) for camera in said["cameras"].values()}


def pictures(scene: Path) -> Counter:
    """How many images of a scene have each size, (width, height)."""
    return Counter(cv2.imread(str(row.image)).shape[1::-1] for row in read_rows(scene))


# --- sizes and shapes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("folder", ["capture", "capture-4"])
def test_cameras_scale_to_smaller_pictures(imported, folder):
    said = imported(f"smaller-pictures/{folder}")
    (camera,) = said["cameras"].values()
    assert (camera["width"], camera["height"]) == (160, 120)
    assert camera["focal_px"] == [144, 144]
    assert camera["centre_px"] == [79.5, 59.5]
    assert "160x120" in said["choices"]["scaled cameras"]


def test_smaller_pictures_with_another_suffix(tmp_path):
    shutil.copytree(CASES / "smaller-pictures/capture-4", tmp_path / "capture")
    for picture in (tmp_path / "capture/images_4").iterdir():
        cv2.imwrite(str(picture.with_suffix(".png")), cv2.imread(str(picture)))
        picture.unlink()
    import_scene(tmp_path / "capture", tmp_path / "scene")
    truth = true_poses(CASES / "smaller-pictures/truth.txt").items()
    assert_true(scene_poses(tmp_path / "scene"), {f"{Path(name).stem}.png": pose for name, pose in truth})


@pytest.mark.parametrize(("kind", "size"), [("same-shape", (96, 72)), ("two-shapes", (128, 72))])
def test_two_devices_are_read_each_with_its_camera(imported, tmp_path, kind, size):
    said = imported(f"two-resolutions/capture-{kind}")
    assert sizes(said) == {(160, 120), size}
    assert pictures(tmp_path / "scene") == {(160, 120): 12, size: 12}
    for camera in said["cameras"].values():
        assert camera["centre_px"] == [camera["width"] / 2 - 0.5, camera["height"] / 2 - 0.5]
    assert ("12 images are shaped otherwise than most: all are used" in said["sanity"]["verdict"]) == (
        size == (128, 72)
    )
    frames = read_split(tmp_path / "scene", "train", BadFrames())
    assert len(frame_intrinsics("capture", tmp_path / "scene", frames)) == len(frames) >= 9


def test_sizes_that_differ_by_pixels_are_cropped_to_one(imported, tmp_path):
    said = imported("undistorted-sizes/capture")
    assert pictures(tmp_path / "scene") == {(158, 118): 24}
    assert "20 of 24 images to the middle" in said["choices"]["cropped"]
    for row in read_rows(tmp_path / "scene"):
        camera = said["cameras"][row.camera]
        whole = cv2.imread(str(CASES / "undistorted-sizes/capture/images" / row.image.name))
        height, width = whole.shape[:2]
        left, top = (width - 158) // 2, (height - 118) // 2
        assert camera["centre_px"] == [width / 2 - 0.5 - left, height / 2 - 0.5 - top]
        assert camera["focal_px"][0] == pytest.approx(FOCAL * width)
        cropped = cv2.imread(str(row.image)).astype(float)
        assert np.abs(cropped - whole[top : top + 118, left : left + 158]).mean() < 3


def test_a_polycam_camera_without_its_size(imported, tmp_path):
    assert sizes(imported("polycam-2025/capture")) == {(160, 120)}


def test_a_polycam_camera_whose_picture_alone_has_a_size(tmp_path):
    shutil.copytree(CASES / "polycam-2025/capture", tmp_path / "capture")
    shutil.rmtree(tmp_path / "capture/keyframes/cameras")
    capture = read_capture(tmp_path / "capture")
    assert {(camera.width, camera.height) for camera in capture.cameras.values()} == {(160, 120)}
    assert len(capture.images) == 24


# --- models and splits -----------------------------------------------------------------------------------------------


def test_the_fullest_of_two_models_is_read_and_the_other_named(imported):
    said = imported("two-models/capture", without=("img_000.jpg", "img_001.jpg"))
    assert said["choices"]["model"] == "sparse/1, with most images of 2; not read: sparse/0 (2 images)"


def test_test_frames_are_the_test_split_and_bad_ones_are_named(imported, tmp_path):
    told = json.loads((CASES / "test-frames/capture/transforms.json").read_text())
    bad = [Path(frame["file_path"]).name for frame in told["frames"] if frame["is_bad"]]
    assert len(bad) == 3
    said = imported("test-frames/capture", without=tuple(bad))
    test = {Path(frame["file_path"]).name for frame in told["test_frames"]}
    assert {row.image.name for row in read_rows(tmp_path / "scene") if row.split == "test"} == test
    assert {Path(file).name: rule for file, rule in said["frames"]["left_out"].items()} == dict.fromkeys(
        bad, "marked is_bad by the capture"
    )
    assert said["split"]["chosen"] == "given"


# --- paths and texts -------------------------------------------------------------------------------------------------


def test_windows_paths_of_another_machine(imported):
    said = imported("paths-elsewhere/windows")
    assert said["choices"]["pictures"].startswith("24 of 24 by the ends of their paths: 'C:")


def test_pictures_beside_the_folder_are_found_where_images_says(imported, tmp_path, capsys):
    with pytest.raises(SystemExit):
        tool(CASES / "paths-elsewhere/up/nerf", "--out", tmp_path / "refused")
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    assert error.endswith("Give the folder of the images with --images.")
    imported("paths-elsewhere/up/nerf", images="paths-elsewhere/up/images")


def test_names_with_spaces_and_brackets(imported):
    assert imported("name-with-space/capture")["frames"]["used"] == 24


@pytest.mark.parametrize("kind", ["no-points", "no-blank-lines"])
def test_a_model_written_by_hand(imported, kind):
    assert imported(f"colmap-by-hand/{kind}")["frames"]["used"] == 24


@pytest.mark.parametrize("kind", ["no-points", "no-blank-lines"])
def test_a_line_that_is_no_picture_is_named_with_the_rule(tmp_path, kind):
    shutil.copytree(CASES / "colmap-by-hand" / kind, tmp_path / "capture")
    file = tmp_path / "capture/sparse/0/images.txt"
    file.write_text(file.read_text() + "25 1 0.5 0 0 0 0 0 1\n")  # without its name
    with pytest.raises(
        InputError, match=r"images\.txt, line (50|26): is neither an image .* two lines an image, the second empty"
    ):
        read_capture(tmp_path / "capture")


def test_files_beside_pictures_are_named_before_structure_from_motion(tmp_path, capsys, monkeypatch):
    """``paths-elsewhere/up`` has images, and the poses in a folder beside."""
    monkeypatch.setattr(
        "mambaloc.importing.sfm.structure.cached_folder", lambda *_: pytest.fail(capsys.readouterr().err)
    )
    with pytest.raises(
        pytest.fail.Exception, match=r"not read: nerf/transforms\.json\. If the poses are there, give that"
    ):
        read_capture(CASES / "paths-elsewhere/up")
