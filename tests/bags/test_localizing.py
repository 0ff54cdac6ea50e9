"""A drive in one bag, imported, trained on and localized into another: errors are those of evaluate.py."""

from __future__ import annotations

import csv
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from bag_writing import FIRST_NS, messages, recorder
from scipy.spatial.transform import Rotation, Slerp
from tiny import TINY_MAMBALOC, write_recipe

from mambaloc.bags.reading import is_bag
from mambaloc.bags.writing import TOPIC
from mambaloc.evaluation import measure_map
from mambaloc.models import Checkpoint
from mambaloc.rendering import default_intrinsics, embedded_room, embedded_walk, render

TOOLS = Path(__file__).parents[2] / "tools"
SIZE, FRAMES, STEP_NS = (160, 120), 96, 100_000_000
CAM, K = "camera_optical", default_intrinsics((160, 120))
BASE_FROM_CAM = np.eye(4)
BASE_FROM_CAM[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
BASE_FROM_CAM[:3, 3] = 0.3, 0.02, 0.5

pytestmark = pytest.mark.slow


def tool(name: str, *words: object) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(TOOLS / f"{name}.py"), run_name="__main__")


def true_poses() -> np.ndarray:
    """Of the camera at the images' times, by SciPy: poses of the base are halfway between these."""
    base, when = base_poses(), np.arange(FRAMES) + 0.5
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = Slerp(np.arange(FRAMES + 1), Rotation.from_matrix(base[:, :3, :3]))(when).as_matrix()
    poses[:, :3, 3] = (base[:-1, :3, 3] + base[1:, :3, 3]) / 2
    return poses @ BASE_FROM_CAM


def base_poses() -> np.ndarray:
    """Twice around, so that other frames see what is held out."""
    return embedded_walk(FRAMES + 1, 3, 0.0, 2 * 360 / FRAMES) @ np.linalg.inv(BASE_FROM_CAM)


@pytest.fixture(scope="module")
def drive(shared_folder):
    """A folder with the bag ``drive``, the scene ``den`` made of it, a tiny run on that, and its bundle with a map."""

    def make(folder: Path) -> None:
        room = embedded_room()
        with recorder(folder / "drive", "mcap") as bag:
            bag.camera("/eye/camera_info", FIRST_NS, CAM, SIZE, K)
            bag.transform(0, "base_link", CAM, BASE_FROM_CAM, "/tf_static")
            for row, pose in enumerate(base_poses()):
                bag.odometry("/odom", FIRST_NS + STEP_NS * row, "odom", "base_link", pose)
            for row, pose in enumerate(true_poses()):
                ns = FIRST_NS + STEP_NS * row + STEP_NS // 2
                bag.image("/eye/image_raw", ns, CAM, render(room, K, pose, SIZE)[0])
        tool("import_scene", folder / "drive", "--out", folder / "den")
        model = {"class_path": "LitMambaLoc", "init_args": TINY_MAMBALOC}
        data = {"scene": str(folder / "den"), "validation": "block", "val_fraction": 0.2}
        recipe = write_recipe(folder / "recipe.yaml", folder, model, data, max_epochs=1)
        options = ["--map.enabled", "true", "--map.width", "160", "--map.key_frames", "60"]
        tool("train", recipe, *options, "--trainer.default_root_dir", folder / "run")
        checkpoint = folder / "run/checkpoints/last.ckpt"
        tool("evaluate", checkpoint, "--out", folder / "evaluated", "--accelerator", "cpu")
        tool("export", checkpoint, "--to", "onnx", "--no-raw-input", "--out", folder / "bundle")

    return shared_folder("drive", make)


def evaluated(path: Path) -> dict[int, tuple[float, float]]:
    """Errors in metres and degrees, by the number of the image in its topic."""
    with path.open() as file:
        return {
            int(Path(row["image"]).stem): (float(row["position_error_m"]), float(row["rotation_error_deg"]))
            for row in csv.DictReader(file)
        }


def localized(path: Path) -> dict[int, tuple[float, float]]:
    """The same of a bag's poses, against where the camera was."""
    truth, errors = true_poses(), {}
    for message in messages(path, TOPIC):
        ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        row, rest = divmod(ns - FIRST_NS - STEP_NS // 2, STEP_NS)
        assert rest == 0
        found = pose_of(message)
        off = Rotation.from_matrix(found[:3, :3].T @ truth[row, :3, :3])
        errors[row] = (np.linalg.norm(found[:3, 3] - truth[row, :3, 3]), np.degrees(off.magnitude()))
    return errors


def pose_of(message) -> np.ndarray:
    """A message's pose as a matrix."""
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    matrix[:3, 3] = at.x, at.y, at.z
    return matrix


@pytest.mark.parametrize("name", ["found", "found.bag"])
def test_a_networks_errors_in_the_optical_frame_are_those_of_evaluate(drive, tmp_path, name):
    """Guess: float32 in ONNX Runtime and in PyTorch agree to 1e-6 m and rad. They do, to 1e-7 and 2e-7."""
    tool("localize", drive / "bundle", drive / "drive", "--out", tmp_path / name, "--no-map")
    assert is_bag(tmp_path / name)
    expected, found = evaluated(drive / "evaluated/predictions.csv"), localized(tmp_path / name)
    common = sorted(expected.keys() & found.keys())
    assert len(common) > len(expected) / 2  # what does not look like the place is left out
    off = np.array([found[row] for row in common]) - [expected[row] for row in common]
    assert np.abs(off[:, 0]).max() < 1e-6
    assert np.radians(np.abs(off[:, 1])).max() < 1e-6


def test_a_maps_errors_in_the_optical_frame_are_those_of_evaluate(drive, tmp_path):
    """Those of poses that the map accepts; evaluate.py measures all that it finds."""
    map_file = drive / "run/map/map.safetensors"
    tool("localize", map_file, drive / "drive", "--out", tmp_path / "found")
    measured = measure_map(map_file, Checkpoint.read(drive / "run/checkpoints/last.ckpt").data())
    table, found = measured.alone.table, localized(tmp_path / "found")
    numbers = [int(path.stem) for path in measured.frames.image_paths]
    accepted = [row for row in np.flatnonzero(measured.alone.is_accepted) if numbers[row] in found]
    assert len(accepted) == measured.alone.is_accepted.sum() > 3
    errors = np.stack((table.position_error_m, table.rotation_error_deg), axis=1)[accepted]
    np.testing.assert_allclose([found[numbers[row]] for row in accepted], errors, atol=1e-6)


def test_a_bags_pictures_are_recorded_at_their_times(drive, tmp_path):
    """The camera's poses, at the headers' times; a camera of the bag itself gives the frusta."""
    chunk = pytest.importorskip("rerun.chunk", reason="needs the extra rerun")
    words = ["--out", tmp_path / "found", "--rerun", tmp_path / "drive.rrd"]
    tool("localize", drive / "run/map/map.safetensors", drive / "drive", *words)
    positions_m, matrices = {}, []
    for each in chunk.RrdReader(tmp_path / "drive.rrd").stream():
        batch = each.to_record_batch()
        if each.entity_path == "/world/camera" and "Transform3D:translation" in batch.schema.names:
            times = batch.column("time").cast("int64").to_pylist()
            positions_m |= dict(zip(times, batch.column("Transform3D:translation").to_pylist(), strict=True))
        elif each.entity_path == "/world/camera/image" and "Pinhole:image_from_camera" in batch.schema.names:
            matrices += batch.column("Pinhole:image_from_camera").to_pylist()
    sent = messages(tmp_path / "found", TOPIC)
    assert len(positions_m) == len(matrices) == len(sent)
    for each in sent:
        ns = each.header.stamp.sec * 10**9 + each.header.stamp.nanosec
        np.testing.assert_allclose(positions_m[ns][0], pose_of(each)[:3, 3], atol=1e-6)
    np.testing.assert_allclose(np.reshape(matrices[0], (3, 3)).T[:2, :2], K[:2, :2], rtol=1e-6)


def test_poses_of_the_robot_are_written_by_its_transforms(drive, tmp_path):
    """The camera's pose times its place on the robot, with a covariance that the arm between them makes larger."""
    for name, options in (("camera", []), ("base", ["--pose-frame", "base_link", "--world-frame", "odom"])):
        tool("localize", drive / "run/map/map.safetensors", drive / "drive", "--out", tmp_path / name, *options)
    for of_camera, of_base in zip(*(messages(tmp_path / name, TOPIC) for name in ("camera", "base")), strict=True):
        np.testing.assert_allclose(pose_of(of_camera) @ np.linalg.inv(BASE_FROM_CAM), pose_of(of_base), atol=1e-9)
        spreads = [np.diag(each.pose.covariance.reshape(6, 6)) for each in (of_camera, of_base)]
        assert spreads[1][:3].sum() > spreads[0][:3].sum() > 0
        assert (of_camera.header.frame_id, of_base.header.frame_id) == ("map", "odom")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--out", "poses.tum"], "--out poses.tum: a bag's poses go into a bag"),
        (["--out", "found", "--filter", "causal"], "--filter causal: a bag's poses are not filtered"),
        (["--out", "found", "--topic", "/up"], "--topic /up"),
        (["--out", "found", "--pose-frame", "arm"], "no transform links the frames 'camera_optical' and 'arm'"),
        (["--out", "."], "already exists"),
    ],
)
def test_wrong_uses_are_refused_in_a_line(drive, tmp_path, monkeypatch, capsys, options, says):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        tool("localize", drive / "run/map/map.safetensors", drive / "drive", *options)
    assert ended.value.code == 2
    assert says in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())
