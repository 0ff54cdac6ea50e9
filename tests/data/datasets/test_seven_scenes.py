"""The 7-Scenes reader: poses as written, and every bad input named in one line or counted."""

from __future__ import annotations

import csv
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.data.datasets.registry import is_official
from mambaloc.data.datasets.seven_scenes import OFFICIAL_COUNTS, read_split
from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError
from mambaloc.rendering import frames_of_sequences, write_7scenes

SPEC_COUNTS = {
    "chess": (4000, 2000),
    "fire": (2000, 2000),
    "heads": (1000, 1000),
    "office": (6000, 4000),
    "pumpkin": (4000, 2000),
    "redkitchen": (7000, 5000),
    "stairs": (2000, 1000),
}


@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_poses_order_and_sequences_are_as_written(write_tiny_scene, kind):
    scene = write_tiny_scene({1: 4, 2: 3, 11: 2}, test=(2,), kind=kind)
    train, test = (read_split(scene.folder, split, BadFrames()) for split in ("train", "test"))
    for frames, ids in ((train, [0, 1, 2, 3, 7, 8]), (test, [4, 5, 6])):
        assert list(frames.image_paths) == [scene.images[i] for i in ids]
        assert frames.position_m.dtype == frames.quaternion.dtype == np.float64
        np.testing.assert_allclose(frames.position_m, scene.position_m(ids), atol=1e-12)
        np.testing.assert_allclose(frames.quaternion, scene.quaternion(ids), atol=1e-12)
    assert train.sequences == ("seq-01",) * 4 + ("seq-11",) * 2
    assert {name: list(rows) for name, rows in train.by_sequence().items()} == {
        "seq-01": [0, 1, 2, 3],
        "seq-11": [4, 5],
    }


def test_sequences_come_in_the_order_of_the_split_file(write_tiny_scene):
    scene = write_tiny_scene({1: 1, 2: 1, 3: 1})
    (scene.folder / "TrainSplit.txt").write_text("sequence3\n\n  Sequence 1 \r\nsequence2\n")
    assert read_split(scene.folder, "train", BadFrames()).sequences == ("seq-03", "seq-01", "seq-02")


def test_select_keeps_rows_together(write_tiny_scene):
    scene = write_tiny_scene({1: 3, 2: 3})
    picked = read_split(scene.folder, "train", BadFrames()).select(np.array([4, 1]))
    assert picked.image_paths == (scene.images[4], scene.images[1])
    assert picked.sequences == ("seq-02", "seq-01")
    np.testing.assert_allclose(picked.position_m, scene.position_m([4, 1]), atol=1e-12)
    np.testing.assert_allclose(picked.quaternion, scene.quaternion([4, 1]), atol=1e-12)


def test_rendered_scene_reads_back(tmp_path):
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", np.random.default_rng(0).uniform(-1, 1, (4, 3))).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(1).uniform(-1, 1, (4, 3))
    shots = frames_of_sequences({1: poses[:3], 2: poses[3:]}, test=(2,))
    folder = write_7scenes(tmp_path, "drawn", shots, size=(32, 24))
    expected = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    for split, rows in (("train", slice(0, 3)), ("test", slice(3, 4))):
        frames = read_split(folder, split, BadFrames())
        np.testing.assert_allclose(frames.position_m, poses[rows, :3, 3], atol=1e-9)
        np.testing.assert_allclose(frames.quaternion, expected[rows], atol=1e-9)


POSE_TEXT = "1 0 0 0.5\n0 1 0 0.5\n0 0 1 0.5\n0 0 0 1\n"
BAD_POSES = {
    "pose is not a 4x4 matrix but has rows of [4, 4, 4]": "1 0 0 0.5\n0 1 0 0.5\n0 0 1 0.5\n",
    "pose is not a 4x4 matrix but has rows of [4, 4, 3, 4]": POSE_TEXT.replace("0 0 1 0.5", "0 0 1"),
    "pose is not a 4x4 matrix but has rows of []": "",
    "pose has NaN or infinite numbers": POSE_TEXT.replace("0.5", "nan"),
    "pose has NaN or infinite numbers ": POSE_TEXT.replace("0.5", "-inf"),
    "pose's last row is not 0 0 0 1": POSE_TEXT.replace("0 0 0 1", "0 0 0 2"),
    "pose's rotation is not orthonormal": POSE_TEXT.replace("0 1 0 0.5", "0 1.1 0 0.5"),
    "pose's rotation is not orthonormal ": POSE_TEXT.replace("1 0 0 0.5", "-1 0 0 0.5", 1),  # a reflection
    "pose's rotation is not orthonormal  ": POSE_TEXT.replace("1 0 0 0.5", "0 0 0 0.5", 1),
    "pose is not a text of numbers": POSE_TEXT.replace("0.5", "half"),
    "pose is not a text of numbers ": bytes(range(256)),
}


@pytest.mark.parametrize(("rule", "content"), BAD_POSES.items())
def test_bad_pose_is_named_or_skipped_and_counted(write_tiny_scene, rule, content):
    rule = rule.strip()
    scene = write_tiny_scene({1: 3})
    pose = scene.folder / "seq-01" / "frame-000001.pose.txt"
    pose.write_bytes(content if isinstance(content, bytes) else content.encode())
    expect_rejection(scene, pose, rule)


def test_pose_without_image(write_tiny_scene):
    scene = write_tiny_scene({1: 3})
    scene.images[1].unlink()
    expect_rejection(scene, scene.folder / "seq-01" / "frame-000001.pose.txt", "pose without image")


def test_image_without_pose(write_tiny_scene):
    scene = write_tiny_scene({1: 3})
    (scene.folder / "seq-01" / "frame-000001.pose.txt").unlink()
    expect_rejection(scene, scene.images[1], "image without pose")


def expect_rejection(scene, path: Path, rule: str) -> None:
    """Frame 1 of 3 is bad: an error in one line that names file and rule, or left out and counted."""
    with pytest.raises(InputError, match=re.escape(f"{path}: {rule}")) as caught:
        read_split(scene.folder, "train", BadFrames("error"))
    assert "\n" not in str(caught.value)
    bad = BadFrames("skip")
    frames = read_split(scene.folder, "train", bad)
    assert list(frames.image_paths) == [scene.images[0], scene.images[2]]
    np.testing.assert_allclose(frames.position_m, scene.position_m([0, 2]), atol=1e-12)
    assert bad.counts() == {rule: 1}
    assert bad.rejected[0].path == path


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "TrainSplit.txt: missing"),
        ("", "TrainSplit.txt: lists no sequence"),
        (" \n\n", "TrainSplit.txt: lists no sequence"),
        ("sequence1\nseq-02\n", "TrainSplit.txt, line 2: 'seq-02' is not a 'sequenceN'"),
        ("sequence1 sequence2\n", "TrainSplit.txt, line 1: 'sequence1 sequence2' is not a 'sequenceN'"),
        ("sequence-1\n", "TrainSplit.txt, line 1: 'sequence-1' is not a 'sequenceN'"),
        ("\x00\x01\ufffd", "TrainSplit.txt, line 1: "),
        ("sequence1\nsequence7\n", "TrainSplit.txt: lists sequence7, but there is no "),
        ("sequence1\nsequence2\nsequence01\n", "TrainSplit.txt, line 3: lists sequence1 again"),
    ],
)
@pytest.mark.parametrize("policy", ["error", "skip"])
def test_bad_split_file_is_an_error_under_any_policy(write_tiny_scene, content, message, policy):
    scene = write_tiny_scene({1: 2, 2: 2})
    split_file = scene.folder / "TrainSplit.txt"
    split_file.unlink()
    if content is not None:
        split_file.write_text(content)
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_split(scene.folder, "train", BadFrames(policy))
    assert "\n" not in str(caught.value)


def test_no_usable_frame_is_an_error_even_when_skipping(write_tiny_scene):
    scene = write_tiny_scene({1: 2})
    for pose in scene.folder.glob("seq-01/*.pose.txt"):
        pose.write_text(POSE_TEXT.replace("0.5", "nan"))
    bad = BadFrames("skip")
    with pytest.raises(InputError, match=r"TrainSplit\.txt: its sequences have no usable frame"):
        read_split(scene.folder, "train", bad)
    assert bad.counts() == {"pose has NaN or infinite numbers": 2}


def test_official_counts_are_those_of_the_specification():
    assert OFFICIAL_COUNTS == SPEC_COUNTS


def test_official_counts_are_those_of_the_real_trajectories(shared_data):
    with (shared_data / "trajectories" / "7scenes.csv").open() as file:
        counts = Counter((row["scene"], row["split"]) for row in csv.DictReader(file))
    assert {scene: (counts[scene, "train"], counts[scene, "test"]) for scene, _ in counts} == OFFICIAL_COUNTS


@pytest.mark.parametrize(
    ("dataset", "scene", "listed", "official"),
    [
        ("7scenes", "stairs", {"train": 2000, "test": 1000}, True),
        ("7scenes", "stairs", {"train": 2000}, True),
        ("7scenes", "stairs", {"test": 1000}, True),
        ("7scenes", "stairs", {"train": 1000, "test": 2000}, False),
        ("7scenes", "stairs", {"train": 2000, "test": 999}, False),
        ("7scenes", "redkitchen", {"train": 800, "test": 200}, False),
        ("7scenes", "den", {"train": 2000, "test": 1000}, False),
        ("cambridge", "stairs", {"train": 2000, "test": 1000}, False),
        ("cambridge", "ShopFacade", {"train": 231, "test": 103}, True),
        ("embedded", "room", {"train": 480, "test": 120}, False),
    ],
)
def test_is_official(dataset, scene, listed, official):
    assert is_official(dataset, scene, listed) is official


def test_real_blocks_have_the_poses_of_the_real_recording(shared_data):
    """The ten blocks of redkitchen/seq-01 hold the poses that the trajectory table gives for it."""
    folder = shared_data / "7scenes_blocks" / "redkitchen"
    with (shared_data / "trajectories" / "7scenes.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["image"].startswith("redkitchen/seq-01/")]
    real = np.array([[float(row[name]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")] for row in rows])
    for split, blocks in (("train", (1, 2, 3, 4, 6, 7, 8, 9)), ("test", (5, 10))):
        frames = read_split(folder, split, BadFrames())
        assert len(frames) == 100 * len(blocks)
        listed = [int(n) for n in re.findall(r"\d+", (folder / f"{split.title()}Split.txt").read_text())]
        assert sorted(listed) == sorted(blocks)
        expected = np.concatenate([real[100 * (block - 1) : 100 * block] for block in listed])
        np.testing.assert_allclose(frames.position_m, expected[:, :3], atol=2e-6)
        relative = Rotation.from_quat(expected[:, 3:]).inv() * Rotation.from_quat(frames.quaternion[:, [1, 2, 3, 0]])
        assert np.degrees(relative.magnitude()).max() < 0.01
        assert (frames.quaternion[:, 0] >= 0).all()
        assert np.abs(frames.position_m).max() < 5
