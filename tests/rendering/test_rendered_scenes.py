"""Rendered scenes on disk, the embedded one, and pose tables: read back by hand, by SciPy and by OpenCV."""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.rendering import (
    Frame,
    default_intrinsics,
    embedded_frames,
    ensure_embedded_scene,
    frames_of_sequences,
    furnished_room,
    parse_size,
    read_pose_table,
    render,
    room_around,
    smooth_trajectory,
    thinned,
    write_7scenes,
    write_cambridge,
)
from mambaloc.rendering.scenes import embedded, layouts

REPOSITORY = Path(__file__).parents[2]
TRAJECTORIES = REPOSITORY.parent / "shared" / "data" / "trajectories"
SIZE = (96, 72)
K = default_intrinsics(SIZE)
INSIDE_M = np.array([[-1.25, -1.0, 1.1], [1.25, 1.0, 1.7]])


@pytest.fixture(scope="module")
def room():
    return furnished_room(INSIDE_M, seed=0, px_per_m=40)


# Scenes on disk


@pytest.fixture
def shots():
    poses = {k: smooth_trajectory(3, k, INSIDE_M) for k in (1, 2, 11)}
    return frames_of_sequences(poses, test=[11])


def test_7scenes_scene_reads_back(tmp_path, room, shots):
    folder = write_7scenes(tmp_path, "den", shots, room=room, size=SIZE, depth=True)
    assert (folder / "TrainSplit.txt").read_text().split() == ["sequence1", "sequence2"]
    assert (folder / "TestSplit.txt").read_text().split() == ["sequence11"]
    assert np.allclose(np.loadtxt(folder / "camera-intrinsics.txt"), K)
    assert json.loads((folder / "scene.json").read_text())["frames"] == {"train": 6, "test": 3}
    for shot in shots:
        image = folder / shot.image
        assert cv2.imread(str(image)).shape == (72, 96, 3)
        pose = np.loadtxt(str(image).replace(".color.png", ".pose.txt"))
        assert np.allclose(pose, shot.world_from_cam, atol=1e-9)
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-8)
        depth_mm = cv2.imread(str(image).replace(".color.png", ".depth.png"), cv2.IMREAD_UNCHANGED)
        assert depth_mm.dtype == np.uint16
        assert np.abs(depth_mm / 1000 - render(room, K, pose, SIZE)[1]).max() < 2e-3


def test_same_seed_writes_the_same_bytes(tmp_path, room, shots):
    first, again, other = (
        write_7scenes(tmp_path, name, shots, room=room, size=SIZE, seed=seed)
        for name, seed in (("first", 0), ("again", 0), ("other", 1))
    )
    files = [path.relative_to(first) for path in first.rglob("*") if path.is_file()]
    assert len(files) == 9 * 2 + 4
    assert all((first / name).read_bytes() == (again / name).read_bytes() for name in files)
    assert (first / shots[0].image).read_bytes() != (other / shots[0].image).read_bytes()


def test_cambridge_labels_are_world_to_camera(tmp_path, room):
    poses = {1: smooth_trajectory(4, 1, INSIDE_M), 2: smooth_trajectory(2, 2, INSIDE_M)}
    shots = frames_of_sequences(poses, test=[2], image="seq{sequence}/frame{frame:05d}.png")
    folder = write_cambridge(tmp_path, "Yard", shots, room=room, size=SIZE)
    for split, number in (("train", 1), ("test", 2)):
        lines = (folder / f"dataset_{split}.txt").read_text().splitlines()
        assert lines[0] == "Visual Landmark Dataset V1"
        assert lines[1] == "ImageFile, Camera Position [X Y Z W P Q R]"
        assert lines[2] == ""
        assert len(lines) == 3 + len(poses[number])
        for line, world_from_cam in zip(lines[3:], poses[number], strict=True):
            image, *words = line.split()
            x, y, z, qw, qx, qy, qz = map(float, words)
            assert (folder / image).is_file()
            assert np.allclose([x, y, z], world_from_cam[:3, 3])
            cam_from_world = Rotation.from_quat([qx, qy, qz, qw]).as_matrix()
            assert np.allclose(cam_from_world.T, world_from_cam[:3, :3], atol=1e-7)


def test_failed_write_leaves_nothing(tmp_path, room, shots, monkeypatch):
    calls = []

    def breaks_down(*args):
        calls.append(args)
        if len(calls) > 4:
            raise RuntimeError("power cut")
        return render(*args)

    monkeypatch.setattr(layouts, "render", breaks_down)
    with pytest.raises(RuntimeError, match="power cut"):
        write_7scenes(tmp_path, "den", shots, room=room, size=SIZE)
    assert list(tmp_path.iterdir()) == []


def test_scene_is_never_overwritten(tmp_path, room, shots):
    (tmp_path / "den").mkdir()
    with pytest.raises(InputError, match="den: already exists"):
        write_7scenes(tmp_path, "den", shots, room=room, size=SIZE)
    assert list((tmp_path / "den").iterdir()) == []


@pytest.mark.parametrize("name", ["", "..", "a/b", ".hidden"])
def test_scene_name_is_a_plain_folder_name(tmp_path, room, shots, name):
    with pytest.raises(InputError, match="plain name"):
        write_7scenes(tmp_path, name, shots, room=room, size=SIZE)


def test_shots_must_fit_the_7scenes_layout(tmp_path, room, shots):
    with pytest.raises(InputError, match="named seq-NN"):
        write_7scenes(tmp_path, "den", [replace(shots[0], image="seq1/frame00001.png")], room=room)
    with pytest.raises(InputError, match="whole sequences"):
        write_7scenes(tmp_path, "den", [*shots, replace(shots[0], split="test")], room=room)
    with pytest.raises(InputError, match="at least one frame"):
        write_7scenes(tmp_path, "den", [], room=room)


# The embedded scene


def test_embedded_test_frames_are_near_training_frames_but_not_among_them():
    shots = embedded_frames()
    train, test = (np.stack([s.world_from_cam for s in shots if s.split == split]) for split in ("train", "test"))
    assert (len(train), len(test)) == (480, 120)
    gap_m = np.linalg.norm(test[:, None, :3, 3] - train[None, :, :3, 3], axis=-1)
    cosine = (np.einsum("aij,bij->ab", test[:, :3, :3], train[:, :3, :3]) - 1) / 2
    gap_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    apart = gap_m + gap_deg / 60
    assert apart.min() > 0.02
    assert np.median(apart.min(axis=1)) < 0.4
    azimuth_deg = np.degrees(np.arctan2(train[:, 1, 2], train[:, 0, 2])) % 360
    assert np.histogram(azimuth_deg, bins=12, range=(0, 360))[0].min() > 10


@pytest.fixture
def quick_embedded(monkeypatch):
    """The embedded scene with three frames to a split and coarse textures."""
    few = thinned(embedded_frames(), 3)
    monkeypatch.setattr(embedded, "embedded_frames", lambda: few)
    monkeypatch.setattr(embedded, "furnished_room", lambda inside_m, seed: furnished_room(inside_m, seed, px_per_m=30))


@pytest.mark.usefixtures("quick_embedded")
def test_embedded_scene_is_rendered_once_by_whoever_comes_first(tmp_path):
    with ThreadPoolExecutor(2) as pool:
        folders = list(pool.map(ensure_embedded_scene, [tmp_path, tmp_path]))
    stamp = (folders[0] / "scene.json").stat().st_mtime_ns
    assert folders == [tmp_path / "room"] * 2
    assert ensure_embedded_scene(tmp_path) == folders[0]
    assert (folders[0] / "scene.json").stat().st_mtime_ns == stamp


@pytest.mark.usefixtures("quick_embedded")
def test_embedded_scene_of_another_version_is_left_alone(tmp_path):
    stale, fresh = tmp_path / "room", tmp_path / f"room-v{layouts.GENERATOR_VERSION}"
    stale.mkdir()
    (stale / "scene.json").write_text("{}")
    assert ensure_embedded_scene(tmp_path) == fresh
    assert ensure_embedded_scene(tmp_path) == fresh
    assert (stale / "scene.json").read_text() == "{}"
    (fresh / "scene.json").unlink()
    with pytest.raises(InputError, match="rendered by another version"):
        ensure_embedded_scene(tmp_path)


@pytest.mark.usefixtures("quick_embedded")
def test_embedded_scene_has_depth_for_every_tenth_frame_and_gets_it_later(tmp_path):
    folder = ensure_embedded_scene(tmp_path)
    depths = {path: path.read_bytes() for path in folder.rglob("*.depth.png")}
    numbers = {int(path.name[6:12]) for path in folder.rglob("*.color.jpg")}
    assert {int(path.name[6:12]) for path in depths} == {number for number in numbers if number % 10 == 0} != set()
    others = {path: path.stat().st_mtime_ns for path in folder.rglob("*.*") if path not in depths}
    for path in depths:
        path.unlink()  # as in a scene that an older version rendered
    assert ensure_embedded_scene(tmp_path) == folder
    assert {path: path.read_bytes() for path in folder.rglob("*.depth.png")} == depths
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.*") if path not in depths} == others


# Tables of poses

HEADER = "scene,split,image,x,y,z,qw,qx,qy,qz\n"
ROW = "den,train,den/seq-01/frame-000000.color.png,1,2,3,2,0,0,0\n"


def table(tmp_path, text):
    path = tmp_path / "poses.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("scene,split,image\n", "line 1: columns x, y, z, qw, qx, qy, qz are missing"),
        (HEADER, "has no row of scene 'den'"),
        (HEADER + ROW + ROW.replace(",1,2", ",one,2"), "line 3: x,y,z,qw,qx,qy,qz must be seven numbers"),
        (HEADER + "den,train,den/seq-01/frame-000000.color.png,1,2\n", "line 2: x,y,z,qw,qx,qy,qz must be"),
        (HEADER + ROW.replace(",1,2", ",nan,2"), "line 2: a pose must be finite"),
        (HEADER + ROW.replace("2,0,0,0", "0,0,0,0"), "line 2: a pose must be finite"),
        (HEADER + ROW.replace("train", "val"), "line 2: split 'val'"),
        (HEADER + ROW.replace("den/seq-01", "../seq-01"), "line 2: image"),
    ],
)
def test_bad_table_is_reported_in_one_line(tmp_path, text, says):
    with pytest.raises(InputError) as caught:
        read_pose_table(table(tmp_path, text), "den", "7scenes")
    assert says in str(caught.value)
    assert "poses.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_table_is_reported(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_pose_table(tmp_path / "none.csv", "den", "7scenes")


def test_table_quaternions_follow_the_dataset(tmp_path):
    half_turns = Rotation.from_rotvec([0.3, -0.5, 0.8])
    x, y, z, w = half_turns.as_quat()
    path = table(tmp_path, HEADER + f"den,test,den/seq-03/frame-000007.color.png,1,2,3,{w},{x},{y},{z}\n")
    for layout, world_from_cam in (("7scenes", half_turns), ("cambridge", half_turns.inv())):
        (shot,) = read_pose_table(path, "den", layout)
        assert shot.image == "seq-03/frame-000007.color.png"
        assert shot.split == "test"
        assert np.allclose(shot.world_from_cam[:3, :3], world_from_cam.as_matrix())
        assert np.allclose(shot.world_from_cam[:3, 3], [1, 2, 3])


def test_thinning_keeps_both_splits_and_their_ends():
    shots = [Frame(str(k), split, np.eye(4)) for split in ("test", "train") for k in range(10)]
    assert [(s.split, s.image) for s in thinned(shots, 3)] == [
        *[("test", k) for k in ("0", "4", "9")],
        *[("train", k) for k in ("0", "4", "9")],
    ]
    assert len(thinned(shots, 99)) == 20
    with pytest.raises(InputError, match="limit 0"):
        thinned(shots, 0)


@pytest.mark.parametrize("text", ["320", "0x240", "320x", "axb", "-3x4"])
def test_size_is_width_by_height(text):
    assert parse_size("640x480") == (640, 480)
    with pytest.raises(InputError, match="WIDTHxHEIGHT"):
        parse_size(text)


@pytest.mark.skipif(not TRAJECTORIES.is_dir(), reason="needs ../shared/data/trajectories beside the repository")
@pytest.mark.parametrize(
    ("layout", "scene"),
    [
        *[("7scenes", s) for s in ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")],
        *[("cambridge", s) for s in ("KingsCollege", "OldHospital", "ShopFacade", "StMarysChurch")],
    ],
)
def test_real_trajectories_render(tmp_path, layout, scene):
    shots = thinned(read_pose_table(TRAJECTORIES / f"{layout}.csv", scene, layout), 10)
    room = room_around(np.stack([s.world_from_cam for s in shots]), seed=0, px_per_m=25)
    write = write_7scenes if layout == "7scenes" else write_cambridge
    folder = write(tmp_path, scene, shots, room=room, size=SIZE)
    assert len(shots) == 20
    for shot in shots:
        assert cv2.imread(str(folder / shot.image)).std() > 12
        _, depth = render(room, K, shot.world_from_cam, SIZE, samples=1)
        assert np.isfinite(depth).all()
        assert depth.min() > 0


def test_wrong_label_is_kept_and_does_not_blow_up_the_room(tmp_path):
    poses = smooth_trajectory(60, 0, INSIDE_M)
    poses[30, :3, 3] = 3e9
    room = room_around(poses, seed=0, px_per_m=25)
    assert np.ptp(room.inside_m, axis=0).max() < 4
    shots = frames_of_sequences({1: poses[28:32]}, test=[])
    folder = write_7scenes(tmp_path, "den", shots, room=room, size=SIZE)
    assert np.loadtxt(folder / "seq-01" / "frame-000002.pose.txt")[0, 3] == 3e9
    assert cv2.imread(str(folder / shots[2].image)).std() > 12


@pytest.mark.parametrize(
    "options",
    [
        ["--poses", "none.csv", "--scene", "den"],
        ["--seed", "2"],  # of the embedded room, which would be written as it always is
    ],
)
def test_tool_reports_a_mistake_in_one_line(options, tmp_path):
    tool = REPOSITORY / "tools" / "render_scene.py"
    command = [sys.executable, str(tool), str(tmp_path), *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
