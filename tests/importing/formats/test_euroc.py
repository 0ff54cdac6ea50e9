"""EuRoC's layout: poses against evo and SciPy, the lens against OpenCV, and every bad input named.

Guesses, made before the files were looked up: the ground truth is of the body, the quaternion has its scalar first,
``T_BS`` is body-from-sensor row after row, and the intrinsics count from the centre of the top-left pixel.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import yaml
from evo.tools.file_interface import read_euroc_csv_trajectory
from scipy.spatial.transform import Rotation

from mambaloc.importing.registry import read_capture

FIRST_NS = 1403636579763555584
STEP_NS = 50_000_000
HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1]"
)
BODY_FROM_CAM = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ]
)  # of the datasets' cam0
LENS = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]


def sensor(matrix=BODY_FROM_CAM, **more) -> str:
    return yaml.safe_dump({"T_BS": {"cols": 4, "rows": 4, "data": matrix.ravel().tolist()}, **more})


def truth(world_from_body, header=HEADER) -> str:
    """Ten times as many poses as images; between these the body stands still, so that the nearest time is right."""
    wxyz = np.roll(Rotation.from_matrix(world_from_body[:, :3, :3]).as_quat(), 1, axis=1)
    rows = [
        ",".join([str(FIRST_NS + row * STEP_NS + k * STEP_NS // 10), *map(repr, (*p, *q)), "0.1"])
        for row, (p, q) in enumerate(zip(world_from_body[:, :3, 3].tolist(), wxyz.tolist(), strict=True))
        for k in range(-4, 5)
    ]
    return "\r\n".join([header, *rows]) + "\r\n"


@pytest.fixture
def source(walk, tmp_path):
    """A walk as it is in the layout, through a pinhole, with a second camera."""
    folder = tmp_path / "V1_01_easy"
    stamps = [FIRST_NS + row * STEP_NS for row in range(len(walk.pngs))]
    walk.write(folder / "mav0/cam0/data", [f"{stamp}.png" for stamp in stamps])
    for name in ("cam1", "state_groundtruth_estimate0"):
        (folder / "mav0" / name).mkdir()
    rows = ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in stamps)]
    (folder / "mav0/cam0/data.csv").write_text("\r\n".join(rows))
    fx, fy, cx, cy = walk.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    (folder / "mav0/cam0/sensor.yaml").write_text(
        sensor(
            sensor_type="camera",
            resolution=list(walk.size),
            camera_model="pinhole",
            intrinsics=[fx, fy, cx, cy],
            distortion_model="radial-tangential",
            distortion_coefficients=[0.0] * 4,
        )
    )
    world_from_body = walk.world_from_cam @ np.linalg.inv(BODY_FROM_CAM)
    (folder / "mav0/state_groundtruth_estimate0/data.csv").write_text(truth(world_from_body))
    (folder / "mav0/state_groundtruth_estimate0/sensor.yaml").write_text(sensor(np.eye(4)))
    return folder


def edit(path, **changed):
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **changed}))


@pytest.mark.parametrize("inner", [".", "mav0"])
def test_a_recording_is_read_and_its_pictures_agree(source, walk, inner):
    capture = read_capture(source / inner)
    assert (capture.kind, capture.unit, set(capture.sequences)) == ("euroc", "metre", {"V1_01_easy"})
    walk.is_agreed(capture)
    np.testing.assert_allclose(capture.time_s, FIRST_NS / 1e9 + np.arange(len(walk.pngs)) / 20)
    assert capture.choices["not read"].startswith("cam1:")
    assert not capture.poses_without_image


def test_poses_of_the_body_are_those_that_evo_reads(source):
    path = source / "mav0/state_groundtruth_estimate0/data.csv"
    evo = read_euroc_csv_trajectory(path)
    capture = read_capture(source)
    rows = [int(np.abs(evo.timestamps - time_s).argmin()) for time_s in capture.time_s]
    world_from_body = np.array(evo.poses_se3)[rows]
    np.testing.assert_allclose(capture.world_from_cam, world_from_body @ BODY_FROM_CAM, atol=1e-9)


def test_the_ground_truth_may_be_of_a_marker_elsewhere_on_the_body(source, walk):
    """As the datasets' vicon0 is, whose T_BS is not an identity; TUM-VI calls its folder mocap0."""
    body_from_marker = np.eye(4)
    body_from_marker[:3] = np.c_[Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), [0.1, -0.05, 0.2]]
    world_from_marker = walk.world_from_cam @ np.linalg.inv(BODY_FROM_CAM) @ body_from_marker
    folder = source / "mav0/state_groundtruth_estimate0"
    (folder / "data.csv").write_text(truth(world_from_marker))
    (folder / "sensor.yaml").write_text(sensor(body_from_marker))
    folder.rename(source / "mav0/mocap0")
    capture = read_capture(source)
    np.testing.assert_allclose(capture.world_from_cam, walk.world_from_cam, atol=1e-6)
    assert capture.choices["ground truth"] == "mocap0"


@pytest.mark.parametrize(
    ("model", "coefficients"), [("radial-tangential", LENS), ("plumb_bob", [*LENS, 0.01]), ("equidistant", LENS)]
)
def test_the_lens_is_opencvs(source, walk, model, coefficients):
    edit(source / "mav0/cam0/sensor.yaml", distortion_model=model, distortion_coefficients=coefficients)
    (camera,) = read_capture(source).cameras.values()
    ray = np.array([[0.4, -0.3]])
    if model == "equidistant":
        expected = cv2.fisheye.distortPoints(ray[None], walk.intrinsics, np.array(coefficients))[0]
    else:
        points = np.array([[0.4, -0.3, 1.0]])
        expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), walk.intrinsics, np.array(coefficients))[0][0]
    np.testing.assert_allclose(camera.distorted(ray), expected, atol=1e-9)


def test_opencvs_own_spelling_of_yaml_is_read(source, walk):
    path = source / "mav0/cam0/sensor.yaml"
    path.write_text("%YAML:1.0\n" + path.read_text())
    np.testing.assert_allclose(read_capture(source).world_from_cam, walk.world_from_cam, atol=1e-6)


def test_pictures_before_the_ground_truth_and_lost_rows_have_no_pose(source):
    path = source / "mav0/state_groundtruth_estimate0/data.csv"
    lines = path.read_text().splitlines()
    later = [line for line in lines if line.startswith("#") or int(line.split(",")[0]) > FIRST_NS + 1.5 * STEP_NS]
    lost = [line if not line.startswith(str(FIRST_NS + 2 * STEP_NS)) else zeroed(line) for line in later]
    path.write_text("\n".join(lost))
    capture = read_capture(source)
    assert [image.stem for image in capture.images_without_pose] == [str(FIRST_NS), str(FIRST_NS + STEP_NS)]
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(capture.world_from_cam).any(axis=(1, 2))), [0])


def zeroed(line: str) -> str:
    stamp, *rest = line.split(",")
    return ",".join([stamp, *rest[:3], "0", "0", "0", "0"])


CAM, TRUTH = "mav0/cam0/sensor.yaml", "mav0/state_groundtruth_estimate0/data.csv"
BAD = {
    "camera_model 'omni' is not read, only pinhole": (CAM, {"camera_model": "omni"}),
    "distortion_model 'double-sphere' is not one of radial-tangential": (CAM, {"distortion_model": "double-sphere"}),
    "has 2 distortion_coefficients, radial-tangential has 4": (CAM, {"distortion_coefficients": [0.1, 0.2]}),
    "'T_BS' must be 16 finite numbers": (CAM, {"T_BS": {"data": [1.0] * 12}}),
    "'intrinsics' must be 4 finite numbers": (CAM, {"intrinsics": "none"}),
    "T_BS: the pose's rotation is not orthonormal": (CAM, {"T_BS": {"data": [2.0, *[0.0] * 14, 1.0]}}),
    "T_BS is not a rotation and translation": (CAM, {"T_BS": {"data": [0.0] * 15 + [1.0]}}),
    "sensor.yaml: is not YAML": (CAM, "a: [1"),
    "sensor.yaml: is not YAML ": (CAM, "a: " + "9" * 5000),
    "sensor.yaml: contains no calibration": (CAM, "- 1"),
    "line 1: names the columns 'p_rs_r_x, p_rs_r_y, p_rs_r_z, q_rs_x": (
        TRUTH,
        HEADER.replace("q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []", "q_RS_x [], q_RS_y [], q_RS_z [], q_RS_w []"),
    ),
    "line 2: is not a row of a time stamp and 7 numbers": (TRUTH, HEADER + "\n1,2,3"),
    "has no pose": (TRUTH, HEADER),
    "none of 1 poses": (TRUTH, HEADER + "\n1403636000000000000,0,0,0,1,0,0,0"),
    "line 2: is not a row 'timestamp, filename'": ("mav0/cam0/data.csv", "#t\na.png"),
    "names '../../x.png', which is not a file inside": ("mav0/cam0/data.csv", f"{FIRST_NS},../../x.png"),
}


@pytest.mark.parametrize(("message", "change"), BAD.items())
def test_bad_input_is_named_in_one_line(source, refused, message, change):
    name, content = change
    if isinstance(content, str):
        (source / name).write_text(content)
    else:
        edit(source / name, **content)
    refused(read_capture, source, message.strip())
