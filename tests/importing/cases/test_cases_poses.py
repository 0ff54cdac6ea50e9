"""Real captures whose poses, time stamps or worlds were read wrongly once: each is read, and as its truth says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from reading_truth import CASES, assert_true, needs_cases, scene_poses, true_poses

from mambaloc.data.datasets.capture import read_split
from mambaloc.data.frames import BadFrames
from mambaloc.importing.importer import import_scene

pytestmark = needs_cases


def imported(source: str, folder: Path):
    """A case as a scene, and what ``scene.json`` says."""
    result = import_scene(CASES / source, folder / "scene")
    return result, json.loads((folder / "scene/scene.json").read_text())


@pytest.mark.parametrize("kind", ["orbslam3", "seconds"])
def test_pictures_named_in_nanoseconds_have_the_poses_of_their_times(tmp_path, kind):
    _, said = imported(f"nanosecond-names/{kind}", tmp_path)
    assert_true(scene_poses(tmp_path / "scene"), true_poses(CASES / "nanosecond-names/truth.txt"))
    association = said["choices"]["association"]
    assert ("timed in s" in association and "named in ns" in association) or kind == "orbslam3"
    assert "association" in (tmp_path / "scene/report.md").read_text()


def test_a_sequence_with_a_pose_file_beside_each_picture(tmp_path):
    _, said = imported("sequence-with-poses/seq-01", tmp_path)
    files = (CASES / "sequence-with-poses/seq-01").glob("*.pose.txt")
    assert_true(
        scene_poses(tmp_path / "scene"), {f"{f.name.partition('.')[0]}.color.jpg": np.loadtxt(f) for f in files}
    )
    assert (said["imported"]["format"], said["unit"]) == ("pose_files", "metre")


def test_sixteen_numbers_a_line(tmp_path):
    imported("other-pose-files/sixteen", tmp_path)
    rows = np.loadtxt(CASES / "other-pose-files/sixteen/poses.txt").reshape(-1, 4, 4)
    assert_true(scene_poses(tmp_path / "scene"), {f"{row:05d}.jpg": pose for row, pose in enumerate(rows)})


def test_a_name_and_seven_numbers_from_world_to_camera(tmp_path):
    """The same walk as in the other cases, in the same order."""
    _, said = imported("other-pose-files/map-free", tmp_path)
    walk = true_poses(CASES / "nanosecond-names/truth.txt").values()
    assert_true(scene_poses(tmp_path / "scene"), {f"frame_{row:05d}.jpg": pose for row, pose in enumerate(walk)})
    assert said["choices"]["direction"] == "world-to-camera, inverted, scalar first"
    assert [camera["focal_px"] for camera in said["cameras"].values()] == [[144.0, 144.0]]


@pytest.mark.parametrize("table", ["good", "two-without-fix"])
def test_positions_in_a_grid_keep_millimetres(tmp_path, table):
    result, said = imported(f"no-fix/{table}.csv", tmp_path)
    given = {Path(name).name: pose for name, pose in true_poses(CASES / f"no-fix/{table}.csv").items()}
    truth = {name: pose for name, pose in given.items() if pose[:3, 3].any()}
    assert_true(scene_poses(tmp_path / "scene"), truth, atol=1e-6)
    assert {Path(file).name for file in result.left_out} == set(given) - set(truth)
    assert len(given) - len(truth) == (2 if table == "two-without-fix" else 0)
    assert all("0 0 0" in rule for rule in result.left_out.values())
    offset_m = said["world"]["offset_m"]
    np.testing.assert_allclose(offset_m, (441547, 5121947, 347), atol=1)
    for part in ("train", "test"):
        frames = read_split(tmp_path / "scene", part, BadFrames())
        known = np.array([truth[path.name][:3, 3] for path in frames.image_paths])
        np.testing.assert_allclose(frames.position_m.astype(np.float32) + np.array(offset_m), known, atol=1e-6)


def test_two_frames_of_a_grid_do_not_move_measures(tmp_path):
    good, _ = imported("no-fix/good.csv", tmp_path / "good")
    two, _ = imported("no-fix/two-without-fix.csv", tmp_path / "two")
    figures = [{each.name: each.figures for each in result.findings} for result in (good, two)]
    for check, figure in (("extent", "diagonal_of_nine_tenths"), ("steps", "median")):
        of_good, of_two = (each[check][figure] for each in figures)
        assert of_two == pytest.approx(of_good, rel=0.1)
