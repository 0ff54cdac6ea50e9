"""RealityScan's table: angles by hand and against rotations about axes, lenses against OpenCV, every bad input named.

Guesses, made before they were looked up: the angles are heading clockwise from north, then pitch, then roll of a camera
that looks down at zero (right); roll is about the optical axis (wrong: about the image's up, a drone's way ahead); px
and py are in millimetres of video, as f is (wrong: shares of the longer side); t1 and t2 are OpenCV's p1 and p2, as in
nerfstudio's reader (wrong: the other way round).
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mambaloc.importing.registry import read_capture

OLDER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
NEWER = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
SHORT = "#name,x,y,alt,heading,pitch,roll,f"
GL_FROM_CV = np.diag([1.0, -1.0, -1.0])


def angles_of(rotation_gl) -> tuple[float, float, float]:
    """Heading, pitch and roll in degrees of Rz(-heading) Rx(pitch) Ry(roll), solved from the matrix by hand."""
    m = rotation_gl
    pitch = np.arcsin(m[2, 1])
    heading = np.arctan2(m[0, 1], m[1, 1])
    roll = np.arctan2(-m[2, 0], m[2, 2])
    return tuple(np.degrees([heading, pitch, roll]).tolist())


def row(name, pose, lens) -> str:
    values = (*pose[:3, 3].tolist(), *angles_of(pose[:3, :3] @ GL_FROM_CV), *lens)
    return ",".join([name, *map(repr, values)])


@pytest.fixture
def lens(walk):
    """The walk's camera: f of a video 36 mm long, and its centre's shares of 320 from the middle."""
    fx, cx, cy = walk.intrinsics[0, 0], walk.intrinsics[0, 2], walk.intrinsics[1, 2]
    return [float(fx * 36 / 320), float((cx + 0.5 - 160) / 320), float((cy + 0.5 - 120) / 320), *[0.0] * 6]


@pytest.fixture
def write(walk, lens, tmp_path):
    names = [f"IMG_{number:04d}.png" for number in range(len(walk.pngs))]
    walk.write(tmp_path / "photos", names)

    def write(header=OLDER, changed=None, text=None):
        told = [row(name, pose, changed or lens) for name, pose in zip(names, walk.world_from_cam, strict=True)]
        (tmp_path / "registration.csv").write_text(text or "\n".join([header, *told]) + "\n")
        return read_capture(tmp_path)

    return write


@pytest.mark.parametrize("header", [OLDER, NEWER, f"#cameras 12\n{OLDER}"])
def test_a_table_is_read_and_its_pictures_agree(write, walk, header):
    capture = write(header)
    assert (capture.kind, capture.unit, set(capture.sequences)) == ("realityscan", "unknown", {"photos"})
    walk.is_agreed(capture)
    assert set(capture.cameras) == {"camera-1"}


@pytest.mark.parametrize(
    ("angles", "forward", "down"),
    [
        ("0,0,0", (0, 0, -1), (0, -1, 0)),  # looks down, north up
        ("90,0,0", (0, 0, -1), (-1, 0, 0)),  # east up: clockwise
        ("0,90,0", (0, 1, 0), (0, 0, -1)),  # level, towards north
        ("90,90,0", (1, 0, 0), (0, 0, -1)),  # level, towards east
        ("0,90,90", (-1, 0, 0), (0, 0, -1)),  # level, turned about the image's up from north to west
    ],
)
def test_what_angles_mean(write, angles, forward, down):
    capture = write(text=f"{SHORT}\nIMG_0000.png,1,2,3,{angles},30\nIMG_0001.png,1,2,4,{angles},30\n")
    rotation = capture.world_from_cam[0, :3, :3]
    np.testing.assert_allclose(rotation[:, 2], forward, atol=1e-12)
    np.testing.assert_allclose(rotation[:, 1], down, atol=1e-12)
    np.testing.assert_array_equal(capture.world_from_cam[0, :3, 3], (1, 2, 3))
    assert capture.cameras["camera-1"].center_px == (159.5, 119.5)  # columns that are not there are zeros
    assert capture.cameras["camera-1"].focal_px[0] == pytest.approx(30 / 36 * 320)


def test_the_principal_point_is_a_share_of_the_longer_side(write, lens):
    lens[1:3] = 0.01, -0.02
    (camera,) = write(changed=lens).cameras.values()
    assert camera.center_px == pytest.approx((159.5 + 3.2, 119.5 - 6.4))


def test_the_lens_is_opencvs_with_its_tangential_terms_swapped(write, walk, lens):
    """As the export format for OpenCV that ships with the program writes them: k1,k2,t2,t1,k3."""
    k1, k2, k3, t1, t2 = -0.09, 0.07, -0.02, -0.003, 0.001
    lens[3:] = k1, k2, k3, 0.0, t1, t2
    (camera,) = write(changed=lens).cameras.values()
    points = np.array([[0.4, -0.3, 1.0], [-0.1, 0.25, 1.0]])
    coefficients = np.array([k1, k2, t2, t1, k3])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), walk.intrinsics, coefficients)[0][:, 0]
    np.testing.assert_allclose(camera.distorted(points[:, :2]), expected, atol=1e-9)


def test_each_distinct_lens_is_a_camera_and_a_damaged_picture_stays_for_the_checks(write, tmp_path):
    (tmp_path / "photos/IMG_0002.png").write_bytes(b"no image")
    rows = [f"IMG_000{n}.png,{n},0,0,0,90,0,{30 + n // 2}" for n in range(4)]
    capture = write(text="\n".join([SHORT, *rows]))
    assert capture.camera_of == ("camera-1", "camera-1", "camera-2", "camera-2")


def test_a_position_that_is_none_has_no_pose(write):
    rows = ["IMG_0000.png,0,0,0,0,90,0,30", "IMG_0001.png,nan,0,0,0,90,0,30", "IMG_0999.png,1,0,0,0,90,0,30"]
    capture = write(text="\n".join([SHORT, *rows]))
    np.testing.assert_array_equal(np.isnan(capture.world_from_cam[:, 0, 3]), [False, True])
    assert capture.poses_without_image == ("IMG_0999.png",)
    assert len(capture.images_without_pose) == 10


BAD = {
    "line 2: is not a row of a name and numbers": "IMG_0000.png,0,0,0,0,90,0",
    "line 2: is not a row of a name and numbers ": "IMG_0000.png,0,0,0,north,90,0,30",
    "has no row below its columns' names": "",
    "line 2: a camera must have a size and finite, positive focal lengths": "IMG_0000.png,0,0,0,0,90,0,-30",
    "names '../a.png', which is not a file inside": "../a.png,0,0,0,0,90,0,30",
    "IMG_0000.png more than one pose": "IMG_0000.png,0,0,0,0,90,0,30\nIMG_0000.png,1,0,0,0,90,0,30",
}


@pytest.mark.parametrize(("message", "rows"), BAD.items())
def test_bad_input_is_named_in_one_line(write, tmp_path, refused, message, rows):
    refused(lambda _: write(text=f"{SHORT}\n{rows}\n"), tmp_path, message.strip())


def test_bad_headers_and_several_tables(write, tmp_path, refused):
    refused(lambda _: write(text=f"{SHORT},x\n1,2\n"), tmp_path, "line 1: names the column 'x' twice; remove one")
    (tmp_path / "other.csv").write_text(SHORT)
    refused(read_capture, tmp_path, "holds other.csv and registration.csv; give the one to read")
    (tmp_path / "table.csv").write_text("name,x,y\n")
    refused(lambda path: read_capture(path, "realityscan"), tmp_path / "table.csv", "names no columns name, x, y, alt")
