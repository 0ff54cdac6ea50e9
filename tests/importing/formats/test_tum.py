"""TUM recordings and trajectories: true poses by time stamps and names, every damage named in one line."""

from __future__ import annotations

import numpy as np
import pytest
from recorded import FRAMES

from mambaloc.errors import InputError
from mambaloc.importing.formats.timing import associated
from mambaloc.importing.formats.tum import read_tum, read_tum_rgbd
from mambaloc.importing.registry import read_capture

START_S = 1305031102.175304


def trajectory(recording, stamps) -> str:
    rows = zip(stamps, recording.position_m, recording.xyzw, strict=True)
    lines = [" ".join([stamp, *(f"{n:.9f}" for n in (*xyz, *xyzw))]) for stamp, xyz, xyzw in rows]
    return "\n".join(["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw", *lines]) + "\n"


@pytest.fixture
def tum(recording, tmp_path):
    """Images at 10 Hz, poses 4 ms later."""
    stamps = [f"{START_S + k / 10:.6f}" for k in range(len(recording.jpegs))]
    recording.write(tmp_path, [f"rgb/{stamp}.png" for stamp in stamps])
    lines = [f"{stamp} rgb/{stamp}.png" for stamp in stamps]
    (tmp_path / "rgb.txt").write_text("# color images\n" + "\n".join(lines) + "\n")
    later = [f"{float(stamp) + 0.004:.6f}" for stamp in stamps]
    (tmp_path / "groundtruth.txt").write_text(trajectory(recording, later))
    return tmp_path


def test_a_recording_is_read_back(tum, recording):
    capture = read_capture(tum)
    assert (capture.kind, capture.unit, capture.cameras, capture.camera_of) == ("tum_rgbd", "metre", {}, None)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-8)
    np.testing.assert_allclose(capture.time_s, START_S + np.arange(len(recording.jpegs)) / 10, atol=1e-6)
    assert [path.read_bytes() for path in capture.images] == recording.jpegs
    assert set(capture.sequences) == {tum.name}
    assert not capture.poses_without_image
    assert not capture.images_without_pose


def test_images_come_in_the_order_of_time(tum, recording):
    lines = (tum / "rgb.txt").read_text().splitlines()
    (tum / "rgb.txt").write_text("\n".join(reversed(lines)))
    np.testing.assert_allclose(read_capture(tum).world_from_cam, recording.world_from_cam, atol=1e-8)


def test_what_is_missing_is_told(tum, recording):
    images = sorted((tum / "rgb").iterdir())
    images[2].unlink()
    poses = (tum / "groundtruth.txt").read_text().splitlines(keepends=True)
    (tum / "groundtruth.txt").write_text("".join(poses[:-1]))
    capture = read_capture(tum)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam[[0, 1, 3, 4]], atol=1e-8)
    assert capture.poses_without_image == (f"rgb/{images[2].name}",)
    assert capture.images_without_pose == (images[5],)


def test_images_are_found_by_the_ends_of_their_paths(tum, recording, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("pictures") / "elsewhere"
    lines = (tum / "rgb.txt").read_text().splitlines()
    moved = [line.replace("rgb/", "/home/user/tum/rgb/") for line in lines]
    (tum / "rgb.txt").write_text("\n".join(moved))
    capture = read_capture(tum)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-8)
    assert "6 of 6 by the ends of their paths" in capture.choices["association"]
    (tum / "rgb").rename(elsewhere)
    with pytest.raises(InputError, match="--images"):
        read_capture(tum)
    found = read_capture(tum, images=elsewhere)
    np.testing.assert_allclose(found.world_from_cam, recording.world_from_cam, atol=1e-8)


def greedy(first, second, most):
    """The published tool's way: all pairs, the closest first."""
    pairs, left, right = [], set(range(len(first))), set(range(len(second)))
    for _, i, j in sorted((abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second)):
        if i in left and j in right and abs(first[i] - second[j]) < most:
            left.remove(i)
            right.remove(j)
            pairs.append((i, j))
    return sorted(pairs)


@pytest.mark.parametrize("seed", range(5))
def test_association_agrees_with_the_published_tool(seed):
    rng = np.random.default_rng(seed)
    first = np.sort(np.arange(60) / 30 + rng.normal(0, 0.003, 60))
    second = rng.permutation(np.arange(0.3, 2, 0.01) + rng.normal(0, 0.001, 170))
    assert associated(first, second) == greedy(first, second, 0.02)


def test_a_pose_is_given_to_the_closest_image_alone():
    assert associated(np.array([0.0, 0.01, 0.5]), np.array([0.012, 0.6])) == [(1, 0)]
    assert associated(np.array([1.0]), np.array([1.02])) == []
    assert associated(np.array([1.0]), np.array([0.985])) == [(0, 0)]


@pytest.mark.parametrize("names", ["frame-{:03d}", "{:06d}"])
def test_a_trajectory_that_names_its_images(recording, tmp_path, names):
    images = recording.write(tmp_path / "images", [names.format(k) + ".jpg" for k in range(len(recording.jpegs))])
    words = [names.format(k) for k in range(len(recording.jpegs))] if "frame" in names else list("012345")
    (tmp_path / "poses.tum").write_text(trajectory(recording, words))
    capture = read_capture(tmp_path)
    assert (capture.kind, capture.unit, capture.time_s) == ("tum", "unknown", None)
    assert capture.images == tuple(images)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-8)
    images[4].unlink()
    capture = read_capture(tmp_path / "poses.tum")
    assert capture.poses_without_image == (words[4],)
    np.testing.assert_allclose(capture.world_from_cam, np.delete(recording.world_from_cam, 4, axis=0), atol=1e-8)


def test_a_trajectory_beside_images_named_by_time(recording, tmp_path):
    stamps = [f"{START_S + k / 10:.6f}" for k in range(len(recording.jpegs))]
    recording.write(tmp_path / "rgb", [f"{stamp}.jpg" for stamp in stamps])
    (tmp_path / "trajectory.txt").write_text(
        trajectory(recording, [f"{float(s) - 0.01:.4f}" for s in stamps[:-1]] + ["9"])
    )
    capture = read_capture(tmp_path)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam[:-1], atol=1e-8)
    np.testing.assert_allclose(capture.time_s, [float(s) for s in stamps[:-1]], atol=1e-6)
    assert [path.name for path in capture.images_without_pose] == [f"{stamps[-1]}.jpg"]


def test_numbers_that_are_no_time_stamps_are_not_guessed(recording, tmp_path, refused):
    recording.write(tmp_path / "rgb", [f"{k:06d}.jpg" for k in range(len(recording.jpegs))])
    (tmp_path / "trajectory.txt").write_text(trajectory(recording, [f"{k / 30:.6f}" for k in range(6)]))
    refused(read_capture, tmp_path, "its poses cannot be matched to images", "000000.jpg", "rgb.txt")


def test_quaternions_that_are_not_unit_are_made_so_and_counted(tum, recording):
    lines = (tum / "groundtruth.txt").read_text().splitlines()
    words = lines[2].split()
    lines[2] = " ".join([*words[:4], *(str(1.1 * float(word)) for word in words[4:])])
    (tum / "groundtruth.txt").write_text("\n".join(lines))
    capture = read_capture(tum)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-8)
    assert capture.choices["quaternions"].startswith("1 of 6 ")


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("groundtruth.txt", "", "is empty"),
        ("groundtruth.txt", None, "groundtruth.txt: missing"),
        ("groundtruth.txt", "1 2 3 4 0 0 0\n", "line 1: is not a line 'timestamp tx ty tz qx qy qz qw'"),
        ("groundtruth.txt", "1 2 3 4 0 0 0 1\n1 2 3 inf 0 0 1\n", "line 2: is not a line"),
        ("groundtruth.txt", "1 2 3 4 0 0 0 0\n", "none of 1 poses"),
        ("groundtruth.txt", f"{START_S} 2 3 4 0 0 0 0.1\n", "line 1: the quaternion is far from unit length"),
        ("groundtruth.txt", "nan 2 3 4 0 0 0 1\n", "is not a time stamp in seconds"),
        ("groundtruth.txt", "x 2 3 4 0 0 0 1\n", "is not a time stamp in seconds"),
        ("groundtruth.txt", "\x00\xff\n", "line 1: is not a line"),
        ("rgb.txt", None, "rgb.txt: missing"),
        ("rgb.txt", "", "names no image; add lines"),
        ("rgb.txt", "1305031102.2 ../../etc/passwd\n", "names '../../etc/passwd', which is not a file inside"),
        ("rgb.txt", "1305031102.2 /etc/passwd\n", "names '/etc/passwd', which is not a file inside"),
        ("rgb.txt", "1305031102.2 C:\\x.png\n", "which is not a file inside"),
        ("rgb.txt", "1305031102.2\n", "line 1: is not a line 'timestamp file'"),
        ("rgb.txt", "nan rgb/a.png\n", "line 1: is not a line 'timestamp file'"),
        ("rgb.txt", f"1 {'a' * 300}.png\n", "which is not a file inside"),
        ("rgb.txt", "1 rgb/a.png\n", "1 are named and missing, such as 'rgb/a.png'"),
    ],
)
def test_damage_is_named_in_one_line(tum, refused, file, content, says):
    (tum / file).unlink()
    if content is not None:
        (tum / file).write_bytes(content.encode("latin-1"))
    refused(read_tum_rgbd, tum, says, str(tum))


def test_an_image_listed_twice_is_refused(tum, refused):
    text = (tum / "rgb.txt").read_text()
    first = text.splitlines()[1].split()[1]
    (tum / "rgb.txt").write_text(text + f"{START_S + 0.4:.6f} {first}\n".replace("0.4", "0.4"))
    lines = text.splitlines()
    (tum / "rgb.txt").write_text("\n".join([*lines[:5], f"{lines[5].split()[0]} {first}"]))
    refused(read_tum_rgbd, tum, "more than one pose")


def test_two_trajectories_are_ambiguous(recording, tmp_path, refused):
    recording.write(tmp_path, [f"{k}.jpg" for k in range(6)])
    for name in ("a.tum", "b.tum"):
        (tmp_path / name).write_text(trajectory(recording, list("012345")))
    refused(read_tum, tmp_path, "holds a.tum and b.tum; give the one to read")
    assert read_tum(tmp_path / "b.tum").kind == "tum"


def test_a_trajectory_without_images(recording, tmp_path, refused):
    (tmp_path / "poses.tum").write_text(trajectory(recording, list("012345")))
    refused(read_tum, tmp_path, "no folder contains an image")


def test_orb_slam3_writes_nanoseconds_as_doubles(recording, tmp_path):
    """Guess: its export for EuRoC is in seconds. It is 1e9 times them with '.000000', off by up to 128 ns."""
    nanoseconds = [1403636579763555584 + k * 50_000_001 for k in range(FRAMES)]
    recording.write(tmp_path / "images", [f"{ns}.png" for ns in nanoseconds])
    poses = zip(nanoseconds, recording.position_m, recording.xyzw, strict=True)
    rows = [f"{1e9 * (ns / 1e9):.6f} " + " ".join(f"{n:.7f}" for n in (*xyz, *turn)) for ns, xyz, turn in poses]
    assert rows[0].startswith("1403636579763555584.000000 ")
    (tmp_path / "CameraTrajectory.txt").write_text("\n".join(rows) + "\n")
    capture = read_capture(tmp_path)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-6)
    assert [int(image.stem) for image in capture.images] == nanoseconds
