"""Files of a pose a line, told by their lines: read as they say, or refused with what to do."""

from __future__ import annotations

import numpy as np
import pytest
from recorded import FRAMES, Recording

from mambaloc.importing.formats.timing import image_stamps, stamps_of
from mambaloc.importing.registry import read_capture
from mambaloc.importing.world import in_its_world


def write(recording, folder, lines, name="poses.txt", names=None):
    names = names or [f"{row:03d}.jpg" for row in range(FRAMES)]
    recording.write(folder / "images", names)
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder


def sevens(recording, order):
    """Lines of positions and quaternions, in an order of their letters: t, and w and v of the quaternion."""
    for position, (x, y, z, w) in zip(recording.position_m, recording.xyzw, strict=True):
        parts = {"t": position, "v": (x, y, z), "w": (w,)}
        yield " ".join(f"{number:.12f}" for letter in order for number in parts[letter])


@pytest.mark.parametrize("name", ["trajectory.txt", "any.log"])
@pytest.mark.parametrize("transposed", [False, True])
def test_sixteen_numbers_are_read_by_rows_or_columns(recording, tmp_path, name, transposed):
    matrices = recording.world_from_cam.swapaxes(1, 2) if transposed else recording.world_from_cam
    lines = [" ".join(map(repr, matrix.ravel().tolist())) for matrix in matrices]
    capture = read_capture(write(recording, tmp_path, lines, name))
    assert (capture.kind, capture.unit) == ("pose_lines", "unknown")
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-9)


def test_a_direction_may_be_named(recording, tmp_path):
    lines = [" ".join(map(repr, matrix.ravel().tolist())) for matrix in np.linalg.inv(recording.world_from_cam)]
    capture = read_capture(write(recording, tmp_path, lines), "pose_lines_cam_from_world")
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-9)


@pytest.mark.parametrize(("header", "order"), [("x y z qw qx qy qz", "twv"), ("x y z qx qy qz qw", "tvw")])
def test_a_header_says_where_the_scalar_is(recording, tmp_path, header, order):
    lines = [f"{row:03d}.jpg {line}" for row, line in enumerate(sevens(recording, order))]
    capture = read_capture(write(recording, tmp_path, [f"# image {header}", *lines]))
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-9)


def test_a_trajectorys_header_may_put_the_scalar_first(recording, tmp_path):
    stamps = [f"{1403636579 + row / 10:.6f}" for row in range(FRAMES)]
    lines = [f"{stamp} {line}" for stamp, line in zip(stamps, sevens(recording, "twv"), strict=True)]
    source = write(
        recording, tmp_path, ["# timestamp tx ty tz qw qx qy qz", *lines], "run.tum", [f"{s}.jpg" for s in stamps]
    )
    np.testing.assert_allclose(read_capture(source).world_from_cam, recording.world_from_cam, atol=1e-9)


EUROC = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"


@pytest.mark.parametrize(
    ("header", "order"),
    [
        (EUROC, "twv"),
        ("# timestamp tx ty tz w x y z", "twv"),
        ("#time x y z w i j k", "twv"),
        ("# timestamp tx ty tz q_x q_y q_z q_w", "tvw"),
        ("# timestamp x[m] y[m] z[m] qw[] qx[] qy[] qz[]", "twv"),
        ("# time_ns pos_x_m pos_y_m pos_z_m quat_w quat_x quat_y quat_z", "twv"),
        ("timestamp (s);x (m);y (m);z (m);qw (-);qx (-);qy (-);qz (-)", "twv"),
        ("# timestamp [s] x y z qw qx qy qz\n# of the room, exported on Monday", "twv"),
        ("# ground truth trajectory, made by my own tool", "tvw"),
        ("# exported (2026-11-29) by my own tool on a b", "tvw"),
        ("# file: 'room.bag'", "tvw"),
    ],
)
def test_headers_of_trajectories_as_programs_write_them(recording, tmp_path, header, order):
    stamps = [f"{1403636579 + row / 10:.6f}" for row in range(FRAMES)]
    lines = [f"{stamp} {line}" for stamp, line in zip(stamps, sevens(recording, order), strict=True)]
    source = write(recording, tmp_path, [header, *lines], "trajectory.txt", [f"{s}.jpg" for s in stamps])
    np.testing.assert_allclose(read_capture(source).world_from_cam, recording.world_from_cam, atol=1e-9)


def test_names_in_quotes(recording, tmp_path):
    names = [f"my image {row}.jpg" for row in range(FRAMES)]
    lines = [f'"{name}" {line}' for name, line in zip(names, sevens(recording, "twv"), strict=True)]
    source = write(recording, tmp_path, ["# image x y z qw qx qy qz", *lines], names=names)
    np.testing.assert_allclose(read_capture(source).world_from_cam, recording.world_from_cam, atol=1e-9)


def test_a_file_may_mix_units_of_times_since_1970(recording, tmp_path):
    """A logger that was updated: milliseconds at first, then nanoseconds."""
    ns = [1700000000_123_000_000 + row * 100_000_000 for row in range(FRAMES)]
    words = [str(each // 10**6 if row < 3 else each) for row, each in enumerate(ns)]
    lines = [f"{word} {line}" for word, line in zip(words, sevens(recording, "tvw"), strict=True)]
    capture = read_capture(write(recording, tmp_path, lines, "trajectory.txt", [f"{each}.jpg" for each in ns]))
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-9)
    assert "poses are timed in ms and ns" in capture.choices["association"]


HEADERS = [
    ("# timestamp {}[mm] {}[mm] {}[mm] qw qx qy qz", "mm", 0.001),
    ("# timestamp {}_cm {}_cm {}_cm qw qx qy qz", "cm", 0.01),
    ("# timestamp {} (feet) {} (feet) {} (feet) qw qx qy qz", "feet", 0.3048),
    ("# timestamp {} [m] {} [m] {} [m] qw [] qx [] qy [] qz []", "m", 1.0),
    ("# timestamp {} {} {} qw qx qy qz", "", None),
]


@pytest.mark.parametrize(("header", "unit", "length_m"), HEADERS)
@pytest.mark.parametrize("kind", ["tum", "pose_lines"])
def test_a_headers_unit_is_that_of_the_positions(recording, tmp_path, kind, header, unit, length_m):
    scaled = Recording(recording.world_from_cam.copy(), recording.jpegs)
    scaled.world_from_cam[:, :3, 3] /= length_m or 1.0
    names = [f"{1403636579 + row / 10:.6f}.jpg" for row in range(FRAMES)]
    first = [name.removesuffix(".jpg") if kind == "tum" else name for name in names]
    lines = [f"{word} {line}" for word, line in zip(first, sevens(scaled, "twv"), strict=True)]
    capture = read_capture(write(recording, tmp_path, [header.format(*"xyz"), *lines], "poses.txt", names))
    assert (capture.kind, capture.metres_per_unit) == (kind, length_m)
    capture, lost = in_its_world(capture, None)
    assert not lost
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-9)
    assert capture.unit == ("unknown" if length_m is None else "metre")
    assert (f"{length_m:g} m, as the columns' names say" if length_m else "unknown") in capture.choices["scale"]
    assert capture.world.metres_per_unit == (length_m or 1.0)


@pytest.mark.parametrize("header", ["# name x[m] y[cm] z[m] qw qx qy qz", "# name x[px] y[px] z[px] qw qx qy qz"])
def test_a_headers_unit_that_is_no_length_is_refused(recording, tmp_path, refused, header):
    lines = [f"{row:03d}.jpg {line}" for row, line in enumerate(sevens(recording, "twv"))]
    source = write(recording, tmp_path, [header, *lines])
    refused(read_capture, source, "poses.txt: its header: positions are in no one unit of length (x [", "in metres.")


@pytest.mark.parametrize("named", ["123456.000", "a.jpg"])
def test_a_header_that_names_columns_must_say_where_the_scalar_is(recording, tmp_path, refused, named):
    stamps = [f"{1403636579 + row / 10:.6f}{'.jpg' * (named == 'a.jpg')}" for row in range(FRAMES)]
    lines = [f"{stamp} {line}" for stamp, line in zip(stamps, sevens(recording, "tvw"), strict=True)]
    source = write(recording, tmp_path, ["# time px py pz q0 q1 q2 q3", *lines], "poses.txt")
    refused(read_capture, source, "its header does not say where the scalar of the quaternions is")


def test_a_time_stamp_alone_is_a_frame_without_a_pose(recording, tmp_path):
    stamps = [f"{1403636579 + row / 10:.6f}" for row in range(FRAMES)]
    lines = [f"{stamp} {line}" for stamp, line in zip(stamps, sevens(recording, "tvw"), strict=True)]
    source = write(recording, tmp_path, [*lines[:3], stamps[3], *lines[4:]], "run.tum", [f"{s}.jpg" for s in stamps])
    is_lost = np.isnan(read_capture(source).world_from_cam).any(axis=(1, 2))
    np.testing.assert_array_equal(np.flatnonzero(is_lost), [3])


@pytest.mark.parametrize(
    ("order", "named", "says"),
    [
        ("twv", True, "do not say where the scalar of their quaternions is. Write a table poses.csv"),
        ("tvw", False, "has 7 numbers a line, which do not say whose pose each is. Write a table poses.csv"),
    ],
)
def test_lines_that_say_too_little_are_refused_with_what_to_do(recording, tmp_path, refused, order, named, says):
    lines = [f"{row:03d}.jpg {line}" if named else line for row, line in enumerate(sevens(recording, order))]
    refused(read_capture, write(recording, tmp_path, lines), says)


def test_an_empty_pose_file_is_a_frame_without_a_pose(recording, tmp_path):
    recording.write(tmp_path, [f"{row:03d}.jpg" for row in range(FRAMES)])
    for row, pose in enumerate(recording.world_from_cam):
        (tmp_path / f"{row:03d}.txt").write_text("" if row == 2 else " ".join(map(repr, pose.ravel().tolist())))
    capture = read_capture(tmp_path)
    assert capture.kind == "pose_files"
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(capture.world_from_cam).any(axis=(1, 2))), [2])


def test_two_files_of_poses_are_ambiguous(recording, tmp_path, refused):
    lines = [" ".join(map(repr, matrix.ravel().tolist())) for matrix in recording.world_from_cam]
    write(recording, tmp_path, lines, "a.txt")
    refused(read_capture, write(recording, tmp_path, lines, "b.txt"), "holds a.txt and b.txt; give the one to read")
    assert read_capture(tmp_path / "a.txt").kind == "pose_lines"


@pytest.mark.parametrize(
    ("word", "unit", "ns"),
    [
        ("1403636579.763555584", "s", 1403636579763555584),
        ("1403636579763", "ms", 1403636579763000000),
        ("1403636579763555", "us", 1403636579763555000),
        ("1403636579763555584.000000", "ns", 1403636579763555584),
        ("1.403636579763555584e+18", "ns", 1403636579763555584),
    ],
)
def test_the_unit_of_times_since_1970_is_their_size(word, unit, ns):
    stamps = stamps_of([word])
    assert (stamps.unit, stamps.ns.tolist()) == (unit, [ns])


@pytest.mark.parametrize("words", [["1_5"], ["nan", "1"], ["x"], ["1e99"], ["1e1000000000"], []])
def test_words_that_are_no_times(words):
    assert stamps_of(words) is None


def test_pictures_that_are_counted_have_no_times(tmp_path):
    assert image_stamps([tmp_path / f"{row:06d}.jpg" for row in range(9)]) is None
    assert image_stamps([tmp_path / f"{row * 33333}.jpg" for row in range(9)]).unit == "us"
