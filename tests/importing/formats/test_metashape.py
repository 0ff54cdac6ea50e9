"""Metashape's cameras: poses against SciPy, lenses against OpenCV and by hand, and every bad input named.

Guesses, made before they were looked up: transforms are camera-to-chunk in OpenCV's axes (right); cx and cy are offsets
from the middle (right); p1 and p2 are OpenCV's (wrong: they are the other way round); the scale is of the chunk, so
that positions are multiplied by it before they are turned (right).
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.importing.capture import Capture
from mambaloc.importing.formats.photogrammetric_lens import photogrammetric_lens
from mambaloc.importing.registry import read_capture

SCALE, SHIFT = 12.354192447331316, np.array([-2499366.429888, -4256836.520906, 4029217.965003])
TURN = Rotation.from_euler("xyz", [40, -100, 15], degrees=True).as_matrix()
REFERENCE = '<reference x="1" y="2" z="3" enabled="true"/>'
RAYS = np.array([[0.4, -0.3], [-0.1, 0.25], [0.0, 0.0]])
K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])


def numbers(values) -> str:
    return " ".join(map(repr, np.ravel(values).tolist()))


def chunk_transform(rotation=TURN, shift=SHIFT, scale=SCALE) -> str:
    return (
        f'<transform><rotation locked="true">{numbers(rotation)}</rotation>'
        f"<translation>{numbers(shift)}</translation><scale>{scale!r}</scale></transform>"
    )


def sensor(number=0, size=(320, 240), kind="frame", **calibration) -> str:
    told = "".join(f"<{name}>{value!r}</{name}>" for name, value in calibration.items())
    return (
        f'<sensor id="{number}" label="M3M" type="{kind}"><resolution width="{size[0]}" height="{size[1]}"/>'
        '<calibration type="frame" class="initial"><f>1</f></calibration>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="{size[0]}" height="{size[1]}"/>{told}'
        "</calibration></sensor>"
    )


def camera(label, pose=None, more="", inner="") -> str:
    told = "" if pose is None else f"<transform>{numbers(pose)}</transform>"
    return f'<camera id="1" sensor_id="0" component_id="0" label="{label}"{more}>{told}{inner}</camera>'


def document(sensors, cameras, transform, more="") -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n  <chunk label="Chunk 1" enabled="true">\n'
        f'<sensors next_id="1">{sensors}</sensors><components next_id="1" active_id="0">'
        f'<component id="0" label="Component 1">{transform}</component></components>'
        f'<cameras next_id="9">{cameras}</cameras>{more}</chunk></document>\n'
    )


def to_chunk(world_from_cam):
    """Poses in a chunk whose transform leads to the world, by hand: p_world = SCALE TURN p_chunk + SHIFT."""
    poses = world_from_cam.copy()
    poses[:, :3, :3] = TURN.T @ world_from_cam[:, :3, :3]
    poses[:, :3, 3] = (world_from_cam[:, :3, 3] - SHIFT) @ TURN / SCALE
    return poses


LENS = {"f": float(K[0, 0])}


@pytest.fixture
def write(walk, tmp_path):
    """Write a walk's images and a document; the camera's middle is the walk's."""
    names = [f"DJI_{row:04d}.png" for row in range(len(walk.pngs))]
    walk.write(tmp_path / "photos", names)

    def write(poses=walk.world_from_cam, transform="", text=None, encoding="utf-8", more="", **calibration) -> Capture:
        fx, cx, cy = walk.intrinsics[0, 0], walk.intrinsics[0, 2], walk.intrinsics[1, 2]
        lens = {"f": float(fx), "cx": float(cx + 0.5 - 160), "cy": float(cy + 0.5 - 120), **calibration}
        cameras = [camera(name.removesuffix(".png"), pose) for name, pose in zip(names, poses, strict=True)]
        grouped = f'<group id="0" label="Group 1" type="folder">{"".join(cameras[:5])}</group>{"".join(cameras[5:])}'
        text = text or document(sensor(**lens), grouped, transform, more)
        (tmp_path / "cameras.xml").write_text(text, encoding=encoding)
        return read_capture(tmp_path)

    return write


def test_a_chunk_without_references_is_read_and_its_pictures_agree(write, walk):
    capture = write()
    assert (capture.kind, capture.unit, set(capture.sequences)) == ("metashape", "unknown", {"photos"})
    walk.is_agreed(capture)


def test_the_components_transform_leads_to_the_world(write, walk):
    """Positions in geocentric metres, as of a chunk with a map's coordinate system."""
    world_from_cam = walk.world_from_cam.copy()
    world_from_cam[:, :3, 3] += SHIFT
    capture = write(to_chunk(world_from_cam), chunk_transform(), more=f"<markers><m>{REFERENCE}</m></markers>")
    np.testing.assert_allclose(capture.world_from_cam, world_from_cam, atol=1e-6)
    assert capture.unit == "metre"


def test_older_files_have_the_transform_in_the_chunk(write, walk):
    capture = write(to_chunk(walk.world_from_cam), more=chunk_transform())
    np.testing.assert_allclose(capture.world_from_cam, walk.world_from_cam, atol=1e-6)
    assert capture.unit == "unknown"  # nobody measured anything: the transform may be a hand's


def test_a_text_of_windows_is_read(write, walk):
    np.testing.assert_allclose(write(encoding="utf-16").world_from_cam, walk.world_from_cam, atol=1e-6)


def test_the_lens_is_opencvs_with_its_tangential_terms_swapped(write, walk):
    told = {"k1": -0.09, "k2": 0.07, "k3": -0.02, "p1": -0.003, "p2": 0.001}
    (found,) = write(**told).cameras.values()
    swapped = np.array([told["k1"], told["k2"], told["p2"], told["p1"], told["k3"]])
    points = np.c_[RAYS, np.ones(3)]
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), walk.intrinsics, swapped)[0][:, 0]
    np.testing.assert_allclose(found.distorted(RAYS), expected, atol=1e-9)


def test_terms_that_opencv_has_not_by_hand():
    """At (0.5, 0): r² = 0.25. x' = 0.5 (1 + k4 / 256) + p1 (0.25 + 0.5) (1 + p3 / 4), y' = p2 / 4 (1 + p3 / 4)."""
    lens = photogrammetric_lens(100.0, (50.0, 40.0), (0, 0, 0, 2.56), (0.04, 0.08, 4.0, 0), (10.0, 5.0))
    x, y = 0.5 * 1.01 + 0.04 * 0.75 * 2, 0.08 * 0.25 * 2
    np.testing.assert_allclose(lens(np.array([[0.5, 0.0]])), [[50 + 110 * x + 5 * y, 40 + 100 * y]])


def test_pixels_that_are_no_squares_are_two_focal_lengths(write, walk):
    """b1 alone is a pinhole: fx = f + b1, as Agisoft's support wrote (forum, topic 6437)."""
    (found,) = write(b1=1.5).cameras.values()
    assert found.distorted is None
    assert found.focal_px == pytest.approx((walk.intrinsics[0, 0] + 1.5, walk.intrinsics[0, 0]))


def test_a_fisheye_is_opencvs():
    told = (0.1, 0.02, -0.003, 0.001)
    lens = photogrammetric_lens(300.0, (159.5, 119.5), told, (0.0,) * 4, is_fisheye=True)
    expected = cv2.fisheye.distortPoints(RAYS[:, None], K, np.array(told))[:, 0]
    np.testing.assert_allclose(lens(RAYS), expected, atol=1e-9)


def test_disabled_and_unaligned_cameras_are_left_out(write, walk, tmp_path):
    poses = walk.world_from_cam
    cameras = [
        *(camera(f"DJI_{row:04d}", poses[row]) for row in range(4)),
        camera("DJI_0004", poses[4], ' enabled="false"'),
        camera("DJI_0005"),
        camera("DJI_0006", poses[6]).replace('component_id="0"', 'component_id="1"'),
        camera("DJI_0007.png", poses[7]),
        camera("DJI_0999", poses[8]),
        camera("DJI_0008", poses[8][:3]),
    ]
    capture = write(text=document(sensor(f=300.0), "".join(cameras), ""))
    assert [image.stem for image in capture.images] == [f"DJI_{row:04d}" for row in (0, 1, 2, 3, 7)]
    rules = {image.split("/")[-1]: rule for image, rule in capture.left_out.items()}
    assert rules["DJI_0004.png"] == "disabled in Metashape"
    assert "transform is not a 4x4 matrix" in rules["DJI_0008.png"]
    assert capture.poses_without_image == ("DJI_0999",)
    assert {image.stem for image in capture.images_without_pose} >= {"DJI_0005", "DJI_0006"}
    assert capture.choices["not read"] == "1 cameras of other components, which were aligned apart"


CAMERAS = camera("DJI_0001", np.eye(4)) + camera("DJI_0002", np.eye(4))
BAD = {
    "is not XML": "<document><chunk>",
    "declares a document type, which may hold entities": '<!DOCTYPE a [<!ENTITY b "c">]><document><chunk/></document>',
    "no camera is aligned": document(sensor(f=300.0), camera("DJI_0001"), ""),
    "sensor 0: has no calibration": document("", CAMERAS, ""),
    "sensor 0: is 'spherical', not a frame or fisheye": document(sensor(kind="spherical", f=300.0), CAMERAS, ""),
    "sensor 0: k1 is not a number": document(sensor(f=300.0, k1="wide"), CAMERAS, ""),
    "sensor 0: a camera must have a size and finite, positive focal lengths": document(sensor(cx=1.0), CAMERAS, ""),
    "sensor 0: principal point 9160, 120 is far": document(sensor(f=300.0, cx=9000.0), CAMERAS, ""),
    "the chunk's transform is not a rotation, translation and scale": document(
        sensor(f=300.0), CAMERAS, chunk_transform(scale=0.0)
    ),
    "the chunk's transform: the pose's rotation is not orthonormal": document(
        sensor(f=300.0), CAMERAS, chunk_transform(np.diag([2.0, 1, 1]))
    ),
    "the chunk's transform has no rotation": document(sensor(f=300.0), CAMERAS, chunk_transform(np.zeros((3, 3)))),
    "more than one pose": document(sensor(f=300.0), 2 * camera("DJI_0001", np.eye(4)), ""),
    "names '../../etc/passwd', which is not a file inside": document(
        sensor(f=300.0), camera("../../etc/passwd", np.eye(4)), ""
    ),
}


@pytest.mark.parametrize(("message", "text"), BAD.items())
def test_bad_input_is_named_in_one_line(write, tmp_path, refused, message, text):
    refused(lambda _: write(text=text), tmp_path, message)


def test_two_files_are_ambiguous(write, tmp_path, refused):
    write()
    (tmp_path / "more.xml").write_text((tmp_path / "cameras.xml").read_text())
    refused(read_capture, tmp_path, "holds cameras.xml and more.xml; give the one to read")
    assert read_capture(tmp_path / "more.xml").kind == "metashape"
