"""Tables of poses: columns in any order, what is ambiguous refused, every damage named in one line."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from recorded import FRAMES

from mambaloc.importing.formats.csv_table import read_csv
from mambaloc.importing.registry import read_capture
from mambaloc.importing.world import in_its_world

OURS = ["scene", "split", "image", "x", "y", "z", "qw", "qx", "qy", "qz"]
TRANSPOSENET = ["", "scene", "split", "seq", "img_path", "t1", "t2", "t3", "q1", "q2", "q3", "q4"]


def lines(recording, columns, *, scene="den", delimiter=",", inverse=False, names=None) -> str:
    names = names or [f"{scene}/seq-01/{k}.jpg" for k in range(FRAMES)]
    written = [delimiter.join(columns)]
    for k, (xyz, xyzw) in enumerate(zip(recording.position_m, recording.xyzw, strict=True)):
        vector = -xyzw[:3] if inverse else xyzw[:3]
        pose = [*xyz, xyzw[3], *vector]
        values = {
            "": k,
            "scene": scene,
            "split": "test" if k > 3 else "train",
            "seq": f"seq-{k // 2}",
            "time": k / 10,
            **dict.fromkeys(("image", "img_path"), names[k]),
            **dict(zip(("x", "y", "z", "qw", "qx", "qy", "qz"), pose, strict=True)),
            **dict(zip(("tx", "ty", "tz"), pose, strict=False)),
            **dict(zip(("t1", "t2", "t3", "q1", "q2", "q3", "q4"), pose, strict=True)),
        }
        written.append(delimiter.join(str(values[column.lower()]) for column in columns))
    return "\n".join(written) + "\n"


@pytest.fixture
def folder(recording, tmp_path):
    recording.write(tmp_path / "den" / "seq-01", [f"{k}.jpg" for k in range(FRAMES)])
    return tmp_path


@pytest.mark.parametrize(
    ("columns", "delimiter"),
    [
        (OURS, ","),
        (OURS[::-1], ","),
        (TRANSPOSENET, ","),
        (["Image", *OURS[3:]], ";"),
        (["image", "tx", "ty", "tz", *OURS[6:]], "\t"),
    ],
)
def test_columns_come_in_any_order(folder, recording, columns, delimiter):
    (folder / "poses.csv").write_text("\ufeff" + lines(recording, columns, delimiter=delimiter), encoding="utf-8")
    for source in (folder, folder / "poses.csv"):
        capture = read_capture(source)
        unit = "metre" if "scene" in columns else "unknown"
        assert (capture.kind, capture.unit, capture.time_s) == ("csv", unit, None)
        np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-12)
        assert [path.read_bytes() for path in capture.images] == recording.jpegs
    split = ("train",) * 4 + ("test",) * 2
    assert capture.split == (split if "split" in columns else None)
    sequences = ("seq-0", "seq-0", "seq-1", "seq-1", "seq-2", "seq-2") if "seq" in columns else ("den/seq-01",) * 6
    assert capture.sequences == sequences


@pytest.mark.parametrize("place", ["den/seq-01", "images/den/seq-01", "seq-01"])
def test_images_lie_by_the_table_or_in_images_or_without_the_scene(recording, tmp_path, place):
    recording.write(tmp_path / place, [f"{k}.jpg" for k in range(FRAMES)])
    (tmp_path / place / "9.jpg").write_bytes(recording.jpegs[0])
    (tmp_path / place / "2.jpg").unlink()
    (tmp_path / "poses.csv").write_text(lines(recording, [*OURS, "time"]))
    capture = read_csv(tmp_path)
    assert capture.poses_without_image == ("den/seq-01/2.jpg",)
    assert capture.images_without_pose == (tmp_path / place / "9.jpg",)
    assert capture.time_s.tolist() == [0, 0.1, 0.3, 0.4, 0.5]
    np.testing.assert_allclose(capture.world_from_cam, np.delete(recording.world_from_cam, 2, axis=0), atol=1e-12)


NAMED = {
    "image,x [m],y [m],z [m],qw [],qx [],qy [],qz []": 1.0,
    "image,pos_x[mm],pos_y[mm],pos_z[mm],q_w,q_x,q_y,q_z": 0.001,
    "#filename;p_RS_R_x [m];p_RS_R_y [m];p_RS_R_z [m];q_RS_w [];q_RS_x [];q_RS_y [];q_RS_z []": 1.0,
    "name,pose.position.x,pose.position.y,pose.position.z,pose.orientation.w,pose.orientation.x,pose.orientation.y,"
    "pose.orientation.z": None,
    "Image Name,Position X [km],Position Y [km],Position Z [km],Quaternion W,Quaternion X,Quaternion Y,"
    "Quaternion Z": 1000.0,
    "img,tx_cm,ty_cm,tz_cm,quat_w,quat_x,quat_y,quat_z": 0.01,
}


@pytest.mark.parametrize(("header", "length_m"), NAMED.items())
def test_names_of_columns_as_programs_write_them(folder, recording, header, length_m):
    delimiter = ";" if ";" in header else ","
    rows = lines(recording, OURS[2:], delimiter=delimiter).splitlines()[1:]
    if length_m not in (None, 1.0):
        cells = [row.split(delimiter) for row in rows]
        scaled = [[each[0], *(repr(float(word) / length_m) for word in each[1:4]), *each[4:]] for each in cells]
        rows = [delimiter.join(each) for each in scaled]
    (folder / "poses.csv").write_text("\n".join([header, *rows]) + "\n")
    capture = read_capture(folder)
    assert capture.metres_per_unit == length_m
    capture, _ = in_its_world(capture, None)
    assert capture.unit == ("unknown" if length_m is None else "metre")
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-12)


def test_frames_by_their_numbers(recording, tmp_path):
    recording.write(tmp_path / "images", [f"frame_{number:05d}.jpg" for number in range(FRAMES)])
    names = list(map(str, range(FRAMES)))
    (tmp_path / "poses.csv").write_text(lines(recording, OURS[2:], names=names).replace("image", "frame", 1))
    np.testing.assert_allclose(read_capture(tmp_path).world_from_cam, recording.world_from_cam, atol=1e-12)


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_decimal_commas_of_spreadsheets(folder, recording, delimiter):
    header, *rows = lines(recording, [*OURS[2:], "time"], delimiter=delimiter).splitlines()
    rows = [delimiter.join([row.split(delimiter)[0], *row.replace(".", ",").split(delimiter)[1:]]) for row in rows]
    (folder / "poses.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-16")
    capture = read_capture(folder)
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-12)
    np.testing.assert_allclose(capture.time_s, np.arange(FRAMES) / 10)


def test_velocities_and_covariances_are_no_positions(folder, recording):
    header = "image,pos_x,pos_y,pos_z,q_w,q_x,q_y,q_z,v_x,v_y,v_z,position_covariance_x,px,py"
    rows = [f"{row},9,9,9,9,9,9" for row in lines(recording, OURS[2:]).splitlines()[1:]]
    (folder / "poses.csv").write_text("\n".join([header, *rows]) + "\n")
    np.testing.assert_allclose(read_capture(folder).world_from_cam, recording.world_from_cam, atol=1e-12)


def test_a_times_unit_is_taken_where_its_size_allows_it(folder, recording):
    """Guess: 0, 100, 200 are taken for seconds unless the name says otherwise. Wrong: steps of 100 are milliseconds."""
    for name, expected in (("time", 0.1), ("time [s]", 100.0), ("time_ms", 0.1), ("timestamp (us)", 1e-4)):
        header, *rows = lines(recording, OURS[2:]).splitlines()
        rows = [f"{row},{100 * number}" for number, row in enumerate(rows)]
        (folder / "poses.csv").write_text("\n".join([f"{header},{name}", *rows]) + "\n")
        np.testing.assert_allclose(read_capture(folder).time_s, expected * np.arange(FRAMES))


def test_a_direction_that_is_not_told_is_asked_for(recording, tmp_path, refused):
    names = [f"KingsCollege/seq1/{k}.png" for k in range(FRAMES)]
    recording.write(tmp_path, names)
    (tmp_path / "poses.csv").write_text(lines(recording, TRANSPOSENET, scene="KingsCollege", inverse=True, names=names))
    refused(read_capture, tmp_path, "poses.csv, line 2: is of Cambridge Landmarks", "--format csv_cam_from_world")
    capture = read_capture(tmp_path, "csv_cam_from_world")
    assert capture.kind == "csv_cam_from_world"
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-12)
    other = read_capture(tmp_path, "csv_world_from_cam").world_from_cam
    np.testing.assert_allclose(other[:, :3, :3], recording.world_from_cam[:, :3, :3].transpose(0, 2, 1), atol=1e-12)
    np.testing.assert_allclose(other[:, :3, 3], recording.position_m)


def test_a_scene_of_several_is_chosen_by_its_folder(folder, recording, refused):
    shutil.copytree(folder / "den", folder / "attic")
    both = lines(recording, OURS) + lines(recording, OURS, scene="attic").partition("\n")[2]
    (folder / "poses.csv").write_text(both)
    refused(read_csv, folder, "holds the scenes den, attic, each with a world of its own")
    capture = read_capture(folder / "attic", "csv")
    assert {path.relative_to(folder).parts[0] for path in capture.images} == {"attic"}
    np.testing.assert_allclose(capture.world_from_cam, recording.world_from_cam, atol=1e-12)


ROW = "a.jpg,0,0,0,1,0,0,0\n"
HEADER = "image,x,y,z,qw,qx,qy,qz\n"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "poses.csv, line 1: must name the image file once"),
        (HEADER, "poses.csv: has no row"),
        ("image,x,y,z\n" + ROW, "line 1: must name the quaternion once (qw,qx,qy,qz or q1,q2,q3,q4)"),
        ("image,qw,qx,qy,qz\n" + ROW, "line 1: must name the position once"),
        (HEADER.replace("image,", "image,tx,ty,tz,") + ROW, "line 1: must name the position once"),
        (HEADER.replace("image,", "image,path,") + ROW, "line 1: must name the image file once"),
        (HEADER.replace("image,", "image,seq,sequence,") + ROW, "line 1: must name the sequence once"),
        (HEADER.replace("y,", "x,") + ROW, "line 1: names the column 'x' twice"),
        ("image,x,y,z,q1,q2,q3,q4\n" + ROW, "line 1: q1,q2,q3,q4 do not say which is the scalar"),
        (
            HEADER.replace("x,y,z", "x [m],y [m],z [ft]") + ROW,
            "line 1: positions are in no one unit of length (x [m], y [m], z [ft]). Write x, y and z in metres.",
        ),
        (HEADER + ROW + "a.jpg,0,0\n", "line 3: has 3 fields, but the first line names 8"),
        (HEADER + ROW.replace("1", "one"), "line 2: x,y,z,qw,qx,qy,qz must be numbers"),
        (HEADER + ROW.replace("1", "0.1"), "line 2: the quaternion is far from unit length"),
        (HEADER + ROW.replace("a.jpg", "../b.jpg"), "line 2: names '../b.jpg', which is not a file inside"),
        (HEADER + ROW.replace("a.jpg", "/b.jpg"), "line 2: names '/b.jpg', which is not a file inside"),
        (HEADER + ROW.replace("a.jpg", ""), "line 2: names '', which is not a file inside"),
        (HEADER + ROW, "has no image with a pose"),
        (
            HEADER.replace("image", "split,image") + "holdout," + ROW,
            "line 2: split 'holdout' is not one of train, val, test",
        ),
        (HEADER.replace("image", "time,image") + "noon," + ROW, "line 2: time 'noon' is not a number of seconds"),
        (HEADER + ROW * 2, "more than one pose"),
        (HEADER + '"' + "a" * 200_000 + '"\n', "is not CSV (field larger than field limit"),
    ],
)
def test_damage_is_named_in_one_line(tmp_path, recording, refused, content, says):
    if "no image" not in says:
        (tmp_path / "a.jpg").write_bytes(recording.jpegs[0])
    (tmp_path / "poses.csv").write_text(content)
    refused(read_csv, tmp_path, says, str(tmp_path))


def test_several_tables_or_none(folder, recording, refused):
    refused(read_csv, folder / "den" / "seq-01", "contains no CSV file")
    for name in ("train.csv", "test.csv"):
        (folder / name).write_text(lines(recording, OURS))
    refused(read_csv, folder, "has several CSV files: test.csv, train.csv")


def test_real_poses_are_those_of_the_table(recording, tmp_path):
    """Rows of the real 7-Scenes table, with images of our own."""
    table = Path(__file__).parents[4] / "shared" / "data" / "trajectories" / "7scenes.csv"
    if not table.is_file():
        pytest.skip(f"no real data at {table}")
    with table.open() as file:
        rows = [row for row in csv.DictReader(file) if row["scene"] == "heads"][: 2 * FRAMES : 2]
    recording.write(tmp_path, [row["image"] for row in rows])
    shutil.copy(table, tmp_path / "7scenes.csv")
    capture = read_csv(tmp_path / "heads")
    np.testing.assert_allclose(
        capture.world_from_cam[:, :3, 3], [[float(row[axis]) for axis in "xyz"] for row in rows], atol=1e-12
    )
    assert len(capture.poses_without_image) == 2000 - FRAMES
