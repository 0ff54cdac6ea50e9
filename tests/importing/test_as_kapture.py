"""An imported scene as kapture: read back by this project, by kapture itself and by hand; every wrong use named."""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.data.datasets.capture import read_rows
from mambaloc.errors import InputError
from mambaloc.importing.as_kapture import write_kapture
from mambaloc.importing.registry import read_capture

SPLITS = {"mapping": "train", "validation": "val", "query": "test"}


@pytest.fixture
def scene(imported_once, tmp_path):
    """The rendered room as a scene, which a test may change."""
    return shutil.copytree(imported_once, tmp_path / "room")


def edit_rows(scene, change) -> None:
    """Change rows of ``frames.csv``, each a dictionary, in place."""
    with (scene / "frames.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    for number, row in enumerate(rows):
        change(number, row)
    with (scene / "frames.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, reader.fieldnames)
        writer.writeheader()
        writer.writerows(rows)


def edit_scene(scene, change) -> None:
    told = json.loads((scene / "scene.json").read_text())
    change(told)
    (scene / "scene.json").write_text(json.dumps(told))


def values(path) -> list[list[str]]:
    return [line.split(", ") for line in path.read_text().splitlines() if not line.startswith("#")]


def test_a_scene_is_read_back_as_it_was(scene, tmp_path):
    edit_rows(scene, lambda number, row: row.update(split="unused") if number == 0 else None)
    counts, unused = write_kapture(scene, tmp_path / "out")
    rows = {row.image.name: row for row in read_rows(scene)}
    assert counts == {name: sum(row.split == split for row in rows.values()) for name, split in SPLITS.items()}
    assert unused == sum(row.split == "unused" for row in rows.values()) > 0
    assert all(counts.values())
    capture = read_capture(tmp_path / "out")
    told = [rows[image.name] for image in capture.images]
    assert len(told) == len(rows) - unused
    poses = np.array([row.pose for row in told])
    np.testing.assert_allclose(capture.world_from_cam[:, :3, 3], poses[:, :3], atol=1e-12)
    turns = Rotation.from_quat(np.roll(poses[:, 3:], -1, axis=1)).as_matrix()
    np.testing.assert_allclose(capture.world_from_cam[:, :3, :3], turns, atol=1e-12)
    assert list(capture.split) == [row.split for row in told]
    (camera,), (given,) = capture.cameras.values(), json.loads((scene / "scene.json").read_text())["cameras"].values()
    assert list(camera.focal_px) == pytest.approx(given["focal_px"])
    assert list(camera.center_px) == pytest.approx(given["centre_px"])
    assert capture.images[0].read_bytes() == told[0].image.read_bytes()


def test_kapture_itself_reads_it(scene, tmp_path):
    """Needs kapture (pip install kapture==1.1.12), which is not an extra of this project: it brings numba."""
    kapture, reader = pytest.importorskip("kapture"), pytest.importorskip("kapture.io.csv")
    write_kapture(scene, tmp_path / "out")
    rows = {row.image.relative_to(scene).as_posix(): row for row in read_rows(scene)}
    count = 0
    for name, split in SPLITS.items():
        if not (tmp_path / "out" / name).is_dir():
            continue
        data = reader.kapture_from_dir(str(tmp_path / "out" / name))
        for stamp, sensor, image in kapture.flatten(data.records_camera):
            world_from_cam = data.trajectories[stamp, sensor].inverse()
            assert rows[image].split == split
            np.testing.assert_allclose(world_from_cam.t_raw, rows[image].pose[:3], atol=1e-9)
            same = abs(np.dot(world_from_cam.r_raw, rows[image].pose[3:]))
            np.testing.assert_allclose(same, 1.0, atol=1e-12)
            assert data.sensors[sensor].camera_type.name == "PINHOLE"
            count += 1
    assert count == sum(row.split != "unused" for row in rows.values())


def test_numbers_by_hand(scene, tmp_path):
    """A camera at (1, 2, 3) of a world shifted by (10, 0, 0), turned by 90 degrees about z: t = -R^T (11, 2, 3)."""
    half = np.sqrt(0.5)

    def place(_, row):
        row |= {"x": "1", "y": "2", "z": "3", "qw": str(half), "qx": "0", "qy": "0", "qz": str(half)}

    edit_rows(scene, place)
    edit_scene(scene, lambda told: told.update(world={"offset_m": [10, 0, 0], "metres_per_unit": 1.0}))
    write_kapture(scene, tmp_path / "out")
    sensors = tmp_path / "out/mapping/sensors"
    (first, *_) = values(sensors / "trajectories.txt")
    np.testing.assert_allclose(list(map(float, first[2:])), [half, 0, 0, -half, -2, 11, -3], atol=1e-12)
    ((_, _, kind, model, width, height, _, _, cx, _),) = values(sensors / "sensors.txt")
    (given,) = json.loads((scene / "scene.json").read_text())["cameras"].values()
    assert (kind, model, width, height) == ("camera", "PINHOLE", str(given["width"]), str(given["height"]))
    assert float(cx) == pytest.approx(given["centre_px"][0] + 0.5)  # from the corner, as in COLMAP
    assert sensors.joinpath("sensors.txt").read_text().startswith("# kapture format: 1.1\n")


def test_time_stamps_are_microseconds_or_counts(scene, tmp_path):
    edit_rows(scene, lambda number, row: row.update(time_s=repr(1403636579.7 + number / 10), split="train"))
    write_kapture(scene, tmp_path / "timed")
    capture = read_capture(tmp_path / "timed")
    assert sorted(capture.time_s) == pytest.approx([1403636579.7 + number / 10 for number in range(40)], abs=1e-6)
    edit_rows(scene, lambda number, row: row.update(time_s="5.0"))  # all at one time
    write_kapture(scene, tmp_path / "counted")
    stamps = [int(row[0]) for row in values(tmp_path / "counted/mapping/sensors/records_camera.txt")]
    assert len(set(stamps)) == len(stamps)
    assert max(stamps) < 40


def test_a_scene_without_cameras_has_uncalibrated_ones(scene, tmp_path):
    edit_scene(scene, lambda told: told.update(cameras={}))
    edit_rows(scene, lambda _, row: row.update(camera=""))
    write_kapture(scene, tmp_path / "out")
    ((*_, model, width, height),) = values(tmp_path / "out/mapping/sensors/sensors.txt")
    assert (model, int(width), int(height)) == ("UNKNOWN_CAMERA", 160, 120)
    assert read_capture(tmp_path / "out").cameras == {}


def test_wrong_uses_are_named_in_one_line_and_leave_nothing(scene, tmp_path):
    (tmp_path / "there").mkdir()
    for folder, out, says in [
        (scene, tmp_path / "there", "there: already exists; remove it"),
        (tmp_path / "there", tmp_path / "out", "scene.json: cannot be read"),
    ]:
        with pytest.raises(InputError, match=says):
            write_kapture(folder, out)
    edit_rows(scene, lambda _, row: row.update(split="unused"))
    with pytest.raises(InputError, match="has no frame for training, validation or testing"):
        write_kapture(scene, tmp_path / "out")
    edit_rows(scene, lambda number, row: row.update(split="train", image=f"images/a,{number}.png"))
    with pytest.raises(InputError, match="has a comma in its path"):
        write_kapture(scene, tmp_path / "out")
    edit_rows(scene, lambda number, row: row.update(split="train", image=f"images/{number}-gone.png"))
    with pytest.raises(InputError, match="pose without image"):
        write_kapture(scene, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["room", "there"]
