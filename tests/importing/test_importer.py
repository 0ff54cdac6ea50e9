"""From ``transforms.json`` to a scene's folder and back, and the tool used rightly and wrongly."""

from __future__ import annotations

import csv
from dataclasses import replace

import cv2
import numpy as np
import pytest
from captures import FOCAL_PX, SIZE, told, tool
from scipy.spatial.transform import Rotation

from mambaloc.data.cameras import frame_intrinsics
from mambaloc.data.datasets.capture import COLUMNS, read_rows, read_split
from mambaloc.data.frames import BadFrames
from mambaloc.data.tracks import Tracks, read_tracks
from mambaloc.images import read_image
from mambaloc.importing.canonical import Imported
from mambaloc.importing.importer import import_scene
from mambaloc.importing.registry import read_capture
from mambaloc.mapping.posed import with_cameras
from mambaloc.rendering import render


@pytest.fixture
def scene(imported_once):
    """The capture as a scene; read only."""
    return imported_once


# --- the scene -------------------------------------------------------------------------------------------------------


def test_a_scene_holds_what_it_should(scene):
    assert sorted(path.name for path in scene.iterdir()) == [
        "agreement.png", "frames.csv", "images", "report.md", "scene.json", "trajectory.png",
    ]  # fmt: skip
    assert scene.stat().st_mode & 0o777 == 0o755
    assert read_image(scene / "trajectory.png").shape[0] > 200


def test_poses_come_back_as_they_were(scene, rendered_once):
    rows = read_rows(scene)
    assert [row.image.name for row in rows] == [f"{number + 1:04d}.png" for number in range(40)]
    poses = np.array([row.pose for row in rows])
    np.testing.assert_allclose(poses[:, :3], rendered_once.world_from_cam[:, :3, 3], atol=1e-12)
    expected = Rotation.from_matrix(rendered_once.world_from_cam[:, :3, :3])
    found = Rotation.from_quat(poses[:, [4, 5, 6, 3]])
    assert np.degrees((expected.inv() * found).magnitude()).max() < 1e-6
    assert (poses[:, 3] >= 0).all()


def test_undistorted_images_are_those_of_the_pinhole_that_is_told(scene, rendered_once, room):
    (camera,) = told(scene)["cameras"].values()
    assert (camera["width"], camera["height"]) == SIZE
    assert camera["lens"]["model"] == "OPENCV"
    assert "distortion removed" in camera["images"]
    matrix = np.array(
        [
            [camera["focal_px"][0], 0, camera["centre_px"][0]],
            [0, camera["focal_px"][1], camera["centre_px"][1]],
            [0, 0, 1],
        ]
    )
    assert not np.isclose(camera["focal_px"][0], FOCAL_PX, rtol=1e-3)
    for row in (0, 13, 39):
        seen = read_image(scene / f"images/images/{row + 1:04d}.png").astype(float)
        expected, _ = render(room, matrix, rendered_once.world_from_cam[row], SIZE)
        distorted = read_image(rendered_once.folder / f"images/{row + 1:04d}.png")
        by_opencv = cv2.undistort(distorted, rendered_once.matrix, rendered_once.coefficients, None, matrix)
        inside = (slice(2, -2), slice(2, -2))
        error, of_opencv = (np.abs(each - expected)[inside].mean() for each in (seen, by_opencv.astype(float)))
        assert error < 6
        assert error < 1.05 * of_opencv + 0.1
        assert error < 0.7 * np.abs(distorted.astype(float) - expected)[inside].mean()
        assert (seen.max(axis=-1) > 0).all()  # no border is black


def test_scene_json_says_where_all_is_from(scene, rendered_once):
    said = told(scene)
    assert said["mambaloc_scene"] == 1
    imported = said["imported"]
    assert imported["format"] == "nerfstudio"
    assert imported["source"] == str(rendered_once.folder)
    assert imported["command"] == "python tools/import_scene.py room"
    assert {"version", "commit", "date"} <= imported.keys()
    assert said["unit"].startswith("unknown: figures that are printed as metres are units")
    assert {"axes", "direction", "world", "scale", "origin", "order", "cameras"} <= said["choices"].keys()
    assert said["frames"] == {"used": 40, "poses_without_image": 0, "images_without_pose": 0, "left_out": {}}
    assert said["sanity"]["checks"]["images and poses"]["share"]["as they were read"] > 0.6
    assert said["sanity"]["checks"]["up"]["axis"] == "+z"
    proposals = {each["by"]: each for each in said["split"]["proposals"]}
    assert said["split"]["chosen"] in proposals
    for each in proposals.values():
        assert set(each["test_to_nearest_train"]) == {"length", "turn_deg", "steps"}
        assert set(each["test_to_nearest_train"]["steps"]) == {"10%", "median", "90%"}


def test_the_report_says_the_same(scene):
    report, said = (scene / "report.md").read_text(), told(scene)
    assert said["sanity"]["verdict"].split(" ", 1)[0] in report
    for check in said["sanity"]["checks"].values():
        assert check["found"].replace("|", "\\|") in report
    assert "![" in report
    assert "honest where at most 10%" in report
    for choice in said["choices"].values():
        assert choice in report


def test_metres_per_unit_scales_positions(rendered_once, tmp_path):
    import_scene(rendered_once.folder, tmp_path / "a", metres_per_unit=2.5)
    poses = np.array([row.pose for row in read_rows(tmp_path / "a")])
    np.testing.assert_allclose(poses[:, :3], 2.5 * rendered_once.world_from_cam[:, :3, 3], atol=1e-12)
    assert told(tmp_path / "a")["unit"] == "metre"
    assert "--metres-per-unit" in told(tmp_path / "a")["choices"]["scale"]


def test_a_world_far_away_is_shifted(rendered, tmp_path):
    def shift(said):
        for frame in said["frames"]:
            for axis, by in enumerate((4.5e5, 5.2e6, 0.0)):
                frame["transform_matrix"][axis][3] += by

    rendered.edit(shift)
    import_scene(rendered.folder, tmp_path / "a")
    poses = np.array([row.pose for row in read_rows(tmp_path / "a")])
    assert np.abs(poses[:, :3]).max() < 5
    np.testing.assert_allclose(
        np.diff(poses[:, :3], axis=0), np.diff(rendered.world_from_cam[:, :3, 3], axis=0), atol=1e-8
    )
    assert "shifted to [449999.0, 5200000.0" in told(tmp_path / "a")["choices"]["origin"]


def test_points_of_the_source_come_along(rendered_once, tmp_path, monkeypatch):
    """In metres, and in the order of frames.csv without the frame whose image is broken."""
    capture = read_capture(rendered_once.folder)
    rows = np.arange(len(capture.images))
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no image")
    images = (capture.images[0], broken, *capture.images[2:])
    tracks = Tracks(np.ones((1, 3)), 0 * rows, rows, np.column_stack((rows, rows)) / 100.0)
    given = replace(capture, images=images, tracks=tracks)
    monkeypatch.setattr("mambaloc.importing.importer.read_capture", lambda *_: given)
    import_scene(rendered_once.folder, tmp_path / "room", metres_per_unit=2.0)
    found = read_tracks(tmp_path / "room", len(rows) - 1)
    assert found.points_m.tolist() == [[2, 2, 2]]
    assert found.frame.tolist() == list(range(len(rows) - 1))
    np.testing.assert_array_equal(found.rays[:, 0], np.delete(rows, 1) / 100.0)
    train = read_split(tmp_path / "room", "train", BadFrames())
    posed = with_cameras("capture", tmp_path / "room", train)
    names = [row.image for row in read_rows(tmp_path / "room")]
    expected = [found.rays[names.index(image), 0] for image in train.image_paths]
    assert posed.tracks.rays[np.argsort(posed.tracks.frame), 0].tolist() == expected


def test_the_report_compares_poses_with_pictures(scene):
    report, checks = (scene / "report.md").read_text(), told(scene)["sanity"]["checks"]
    assert "## Poses and images" in report
    assert "![Matches that agree, by baseline and by focal length](agreement.png)" in report
    bins = checks["images and poses"]["by_baseline"]
    assert sum(each["matches"] for each in bins) > 1000
    assert all(0 < each["share"] <= each["possible"] <= 1 for each in bins)
    assert bins[-1]["high"] is None
    assert abs(checks["focal length"]["best_over_given"] - 1) < 0.03


def test_adjusted_poses_are_written_beside_the_given(rendered, tmp_path):
    """The given poses are off by a seeded 5 mm and 0.3 deg; the adjusted must be nearer to the truth."""
    rng = np.random.default_rng(0)

    def disturb(said):
        for frame in said["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, :3] = Rotation.from_rotvec(np.radians(0.3) * rng.normal(size=3)).as_matrix() @ pose[:3, :3]
            pose[:3, 3] += 0.005 * rng.normal(size=3)
            frame["transform_matrix"] = pose.tolist()

    rendered.edit(disturb)
    tool(rendered.folder, "--out", tmp_path / "scene", "--adjust-poses")
    off = {}
    for name in ("frames.csv", "frames_adjusted.csv"):
        with (tmp_path / "scene" / name).open() as file:
            rows = list(csv.DictReader(file))
        position = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
        turn = Rotation.from_quat([[float(row[axis]) for axis in ("qx", "qy", "qz", "qw")] for row in rows])
        apart = turn.inv() * Rotation.from_matrix(rendered.world_from_cam[:, :3, :3])
        distance = np.linalg.norm(position - rendered.world_from_cam[:, :3, 3], axis=1)
        off[name] = distance.mean(), np.degrees(apart.magnitude()).mean()
    given, adjusted = off.values()
    assert adjusted[0] < 0.8 * given[0]
    assert adjusted[1] < 0.6 * given[1]
    said = told(tmp_path / "scene")["sanity"]["checks"]
    assert all(each["adjusted"] > each["share"] for each in said["images and poses"]["by_baseline"][:2])
    assert 0 < said["adjusted poses"]["moved"] < 0.03
    report = (tmp_path / "scene/report.md").read_text()
    assert "nothing uses unless it is renamed" in report
    assert "images alone prefer turns that are too small" in report
    # Cameras come into use with the poses, once the file is renamed, and not before.
    (scale,) = said["adjusted poses"]["focal_over_given"].values()
    given_px = focal_px(tmp_path / "scene")
    (tmp_path / "scene/frames_adjusted.csv").rename(tmp_path / "scene/frames.csv")
    assert 0.97 < scale < 1.03
    assert scale != 1
    given, adjusted = told(tmp_path / "scene")["cameras"].values()
    assert given_px == given["focal_px"][0]
    assert adjusted["centre_px"] == given["centre_px"]
    assert focal_px(tmp_path / "scene") == pytest.approx(scale * given_px, rel=1e-4)


def focal_px(scene):
    """Of the first training frame."""
    return frame_intrinsics("capture", scene, read_split(scene, "train", BadFrames()))[0, 0, 0]


# --- the tool --------------------------------------------------------------------------------------------------------


def test_the_tool_says_what_it_found(rendered_once, tmp_path, capsys):
    tool(rendered_once.folder, "--out", tmp_path / "room", "--metres-per-unit", "1")
    said = capsys.readouterr().out
    assert said.startswith(f"{tmp_path / 'room'}: usable")
    for word in ("frames", "images and poses", "steps", "train/val/test", "block", "chosen:"):
        assert word in said
    assert f"--data.scene {tmp_path / 'room'}" in said
    with (tmp_path / "room/frames.csv").open() as file:
        assert tuple(next(csv.reader(file))) == COLUMNS
    assert f"--out {tmp_path / 'room'} --metres-per-unit 1" in told(tmp_path / "room")["imported"]["command"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{tmp}/nothing", "--out", "{tmp}/a"], "no such file or folder"),
        (["{room}", "--out", "{room}"], "already exists; remove it"),
        (["{room}", "--out", "{tmp}/a", "--format", "tango"], "unknown --format tango; choose one of"),
        (["{room}", "--out", "{tmp}/a", "--metres-per-unit", "0"], "--metres-per-unit 0.0: give a number"),
        (["{room}", "--out", "{tmp}/a", "--metres-per-unit", "nan"], "--metres-per-unit nan: give a number"),
        (["{room}", "--out", "{tmp}/a", "--split", "given"], "--split given: this capture has no split of its own"),
        (["{room}", "--out", "{tmp}/a", "--split", "sequence"], "this capture has one sequence; choose one of auto"),
        (["{tmp}", "--out", "{tmp}/a"], "the format is not recognized"),
        (["{room}", "--out", "{tmp}/file/a"], "choose another folder with --out"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(words, message, rendered_once, tmp_path, capsys):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as exit_:
        tool(*(word.format(tmp=tmp_path, room=rendered_once.folder) for word in words))
    assert exit_.value.code == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "a").exists()
    assert not list(tmp_path.glob(".*"))


def test_imported_says_its_unit():
    fields = dict.fromkeys(("lenses", "split", "findings", "verdict", "proposals", "chosen", "left_out"))
    for unit, said in (("metre", "m"), ("unknown", "units")):
        capture = type("Capture", (), {"unit": unit})()
        assert Imported(capture=capture, **fields).unit == said
