"""The Cambridge Landmarks reader: its convention turned round, and every bad line named or counted."""

from __future__ import annotations

import csv
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.data.datasets.cambridge import OFFICIAL_COUNTS, read_split
from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError
from mambaloc.rendering import frames_of_sequences, write_cambridge

HEADER = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
GOOD = "1.5 -2 0.25 0.5 0.5 -0.5 0.5"


def write_list(folder: Path, lines: list[str], split: str = "train", header: str = HEADER, missing: str = "") -> Path:
    """Write a split file, and an image for each line that names one inside the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for line in lines:
        image = folder / line.split()[0]
        if ".." not in image.parts and image.is_relative_to(folder) and image != folder and image.name != missing:
            image.parent.mkdir(parents=True, exist_ok=True)
            image.touch()
    file = folder / f"dataset_{split}.txt"
    file.write_text(header + "".join(f"{line}\n" for line in lines))
    return file


def test_the_files_quaternion_is_world_to_camera(tmp_path):
    """A world point seen by a camera: ``p_cam = R_file (p_world - centre)``, the dataset's own definition."""
    rng = np.random.default_rng(0)
    cam_from_world, center = Rotation.from_quat(rng.normal(size=(8, 4))), rng.uniform(-50, 50, (8, 3))
    wxyz = cam_from_world.as_quat()[:, [3, 0, 1, 2]]  # of either sign
    names = [f"seq{1 + i // 5}/frame{i:05d}.png" for i in range(8)]
    write_list(
        tmp_path,
        [f"{n} {' '.join(map(repr, map(float, (*c, *q))))}" for n, c, q in zip(names, center, wxyz, strict=True)],
    )
    frames = read_split(tmp_path, "train", bad := BadFrames())
    assert [str(path.relative_to(tmp_path)) for path in frames.image_paths] == names
    assert frames.sequences == ("seq1",) * 5 + ("seq2",) * 3
    assert not bad.repaired
    np.testing.assert_array_equal(frames.position_m, center)
    world_from_cam = Rotation.from_quat(frames.quaternion[:, [1, 2, 3, 0]])
    seen = cam_from_world.apply(np.array([3.0, 4, 5]) - center)
    np.testing.assert_allclose(world_from_cam.apply(seen) + frames.position_m, np.tile([3.0, 4, 5], (8, 1)), atol=1e-9)
    assert (frames.quaternion[:, 0] >= 0).all()


def test_rendered_scene_reads_back(tmp_path):
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", np.random.default_rng(0).uniform(-1, 1, (4, 3))).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(1).uniform(-1, 1, (4, 3))
    shots = frames_of_sequences({1: poses[:3], 2: poses[3:]}, test=(2,), image="seq{sequence}/frame{frame:05d}.png")
    folder = write_cambridge(tmp_path, "drawn", shots, size=(32, 24))
    expected = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    for split, rows in (("train", slice(0, 3)), ("test", slice(3, 4))):
        frames = read_split(folder, split, BadFrames())
        np.testing.assert_allclose(frames.position_m, poses[rows, :3, 3], atol=1e-8)
        np.testing.assert_allclose(frames.quaternion, expected[rows], atol=1e-8)


@pytest.mark.parametrize(
    ("line", "rule"),
    [
        ("seq1/b.png 1 2 3 1 0 0", "has 6 numbers instead of seven after the image"),
        ("seq1/b.png 1 2 3 1 0 0 0 0", "has 8 numbers instead of seven after the image"),
        ("seq1/b.png", "has 0 numbers instead of seven after the image"),
        ("seq1/b.png 1 2 three 1 0 0 0", "is not an image and seven numbers"),
        ("seq1/b .png 1 2 3 1 0 0 0", "is not an image and seven numbers"),
        ("../b.png " + GOOD, "names an image outside the scene's folder"),
        ("seq1/../../b.png " + GOOD, "names an image outside the scene's folder"),
        ("/etc/hostname " + GOOD, "names an image outside the scene's folder"),
        (". " + GOOD, "names an image outside the scene's folder"),
        ("seq1/b.png 3.1e9 2 3 1 0 0 0", "has a position that is not finite or beyond 100000 m"),
        ("seq1/b.png 1 -100001 3 1 0 0 0", "has a position that is not finite or beyond 100000 m"),
        ("seq1/b.png 1 nan 3 1 0 0 0", "has a position that is not finite or beyond 100000 m"),
        ("seq1/b.png 1 2 3 0 0 0 0", "has a quaternion near zero"),
        ("seq1/b.png 1 2 3 0.1 0.1 0 0", "has a quaternion near zero"),
    ],
)
def test_bad_line_is_named_or_skipped_and_counted(tmp_path, line, rule):
    file = write_list(tmp_path / "den", [f"seq1/a.png {GOOD}", line, f"seq1/c.png {GOOD}"])
    expect_rejection(tmp_path / "den", f"{file}, line 5", rule)


def test_missing_image_is_named_or_skipped_and_counted(tmp_path):
    write_list(tmp_path / "den", [f"seq1/{name}.png {GOOD}" for name in "abc"], missing="b.png")
    expect_rejection(tmp_path / "den", str(tmp_path / "den" / "seq1" / "b.png"), "pose without image")


@pytest.mark.parametrize(
    ("scene", "image"),
    [
        ("GreatCourt", "seq5/frame00297.png"),
        ("ShopFacade", "seq2/frame00036.png"),
        ("ShopFacade", "seq2/frame00043.png"),
        ("ShopFacade", "seq2/frame00043.jpg"),
    ],
)
def test_known_bad_label_is_rejected_by_name(tmp_path, scene, image):
    lines = [f"seq1/a.png {GOOD}", f"{image} {GOOD}", f"seq1/c.png {GOOD}"]
    write_list(tmp_path / scene, lines)
    expect_rejection(tmp_path / scene, str(tmp_path / scene / image), "is a known bad label of the dataset")
    write_list(tmp_path / "elsewhere", lines)
    assert len(read_split(tmp_path / "elsewhere", "train", BadFrames())) == 3


def expect_rejection(folder: Path, place: str, rule: str) -> None:
    """Line b of a, b, c is bad: an error in one line that names place and rule, or left out and counted."""
    with pytest.raises(InputError, match=re.escape(f"{place}: {rule}")) as caught:
        read_split(folder, "train", BadFrames("error"))
    assert "\n" not in str(caught.value)
    bad = BadFrames("skip")
    frames = read_split(folder, "train", bad)
    assert [path.name for path in frames.image_paths] == ["a.png", "c.png"]
    np.testing.assert_array_equal(frames.position_m, [[1.5, -2, 0.25]] * 2)
    assert bad.counts() == {rule: 1}
    assert str(bad.rejected[0].path) == place


@pytest.mark.parametrize("scale", [2.0, 0.9, 1.002, 1e200])
def test_quaternion_of_another_length_is_normalized_and_counted(tmp_path, scale):
    wxyz = np.array([0.1, -0.7, 0.5, 0.5]) / np.linalg.norm([0.1, -0.7, 0.5, 0.5])
    write_list(tmp_path, [f"seq1/a.png 1 2 3 {' '.join(map(str, scale * wxyz))}", f"seq1/b.png {GOOD}"])
    frames = read_split(tmp_path, "train", bad := BadFrames("error"))
    expected = Rotation.from_quat(wxyz[[1, 2, 3, 0]]).inv().as_quat(canonical=True)[[3, 0, 1, 2]]
    np.testing.assert_allclose(frames.quaternion[0], expected, atol=1e-12)
    assert [repair.path.name for repair in bad.repaired] == ["a.png"]
    assert not bad.rejected


def test_rounded_quaternion_is_no_repair(tmp_path):
    write_list(tmp_path, ["seq1/a.png 1 2 3 0.7071 0.7071 0 0"])
    read_split(tmp_path, "train", bad := BadFrames())
    assert not bad.repaired


@pytest.mark.parametrize(
    ("header", "lines", "message"),
    [
        (None, [], "dataset_train.txt: missing"),
        ("", [], "dataset_train.txt: has no usable frame"),
        (HEADER, [], "dataset_train.txt: has no usable frame"),
        ("", ["a.png", "b.png", "c.png", "d.png"], "dataset_train.txt, line 1: is a frame"),
        ("Visual Landmark Dataset V1\nImageFile\n", ["a.png", "b.png"], "dataset_train.txt, line 3: is a frame"),
    ],
)
@pytest.mark.parametrize("policy", ["error", "skip"])
def test_bad_split_file_is_an_error_under_any_policy(tmp_path, header, lines, message, policy):
    """Without its three header lines a file would lose its first frames unseen."""
    if header is not None:
        write_list(tmp_path, [f"{name} {GOOD}" for name in lines], header=header)
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_split(tmp_path, "train", BadFrames(policy))
    assert "\n" not in str(caught.value)


def test_no_usable_frame_is_an_error_even_when_skipping(tmp_path):
    write_list(tmp_path, [f"seq1/a.png {GOOD}"], missing="a.png")
    bad = BadFrames("skip")
    with pytest.raises(InputError, match=r"dataset_train\.txt: has no usable frame"):
        read_split(tmp_path, "train", bad)
    assert bad.counts() == {"pose without image": 1}


@pytest.fixture(scope="module")
def real_rows(shared_data) -> dict[tuple[str, str], list[dict[str, str]]]:
    rows: dict[tuple[str, str], list[dict[str, str]]] = {}
    with (shared_data / "trajectories" / "cambridge.csv").open() as file:
        for row in csv.DictReader(file):
            rows.setdefault((row["scene"], row["split"]), []).append(row)
    return rows


def test_official_counts_are_those_of_the_real_trajectories(real_rows):
    counts = {scene: (len(real_rows[scene, "train"]), len(real_rows[scene, "test"])) for scene in OFFICIAL_COUNTS}
    assert counts == OFFICIAL_COUNTS
    assert sorted(counts) == ["KingsCollege", "OldHospital", "ShopFacade", "StMarysChurch"]


@pytest.mark.parametrize(
    ("scene", "split", "every", "rejected", "repaired"),
    [
        ("ShopFacade", "train", 1, {"is a known bad label of the dataset": 2}, 0),
        ("ShopFacade", "test", 1, {}, 0),
        ("KingsCollege", "test", 2, {}, 0),
        ("StMarysChurch", "test", 1, {}, 2),
        ("GreatCourt", "test", 10, {}, 0),
    ],
)
def test_real_labels_read_back_equal(real_rows, tmp_path, scene, split, every, rejected, repaired):
    rows = real_rows[scene, split][::every]
    columns = ("x", "y", "z", "qw", "qx", "qy", "qz")
    images = [row["image"].removeprefix(f"{scene}/") for row in rows]
    write_list(
        tmp_path / scene, [f"{i} {' '.join(r[c] for c in columns)}" for i, r in zip(images, rows, strict=True)], split
    )
    frames = read_split(tmp_path / scene, split, bad := BadFrames("skip"))
    assert bad.counts() == rejected
    assert len(bad.repaired) == repaired
    numbers = {i: np.array([float(r[c]) for c in columns]) for i, r in zip(images, rows, strict=True)}
    kept = [str(path.relative_to(tmp_path / scene)) for path in frames.image_paths]
    assert Counter(images) - Counter(kept) == Counter(str(r.path.relative_to(tmp_path / scene)) for r in bad.rejected)
    assert kept == [image for image in images if image in set(kept)]
    labels = np.stack([numbers[image] for image in kept])
    np.testing.assert_array_equal(frames.position_m, labels[:, :3])
    expected = Rotation.from_quat(labels[:, [4, 5, 6, 3]]).inv().as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(frames.quaternion[:, [1, 2, 3, 0]]).as_matrix(), expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(frames.quaternion, axis=1), 1, atol=1e-12)
