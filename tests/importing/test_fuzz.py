"""Whatever is in a file, a reader gives a capture or one line: random bytes, damaged files, random JSON.

``HYPOTHESIS_PROFILE=nightly pytest tests/importing/test_fuzz.py`` tries forty times as much.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from contextlib import nullcontext
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mambaloc.errors import InputError
from mambaloc.importing.registry import FORMATS, read_capture

PICTURE = cv2.imencode(".png", np.zeros((4, 6, 3), np.uint8))[1].tobytes()
DEPTH = cv2.imencode(".png", np.ones((4, 6), np.uint16))[1].tobytes()
EYE12 = "1 0 0 0 0 1 0 0 0 0 1 0\n"
EYE16 = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
LENS = {"w": 6, "h": 4, "fx": 5.0, "fy": 5.0, "cx": 3.0, "cy": 2.0}
KEYFRAME = {f"t_{i}{j}": float(i == j) for i in range(3) for j in range(4)} | LENS | {"width": 6, "height": 4}
METADATA = {"poses": [[0, 0, 0, 1, k, 0, 0] for k in range(2)], "K": [5, 0, 0, 0, 5, 0, 3, 2, 1], "w": 6, "h": 4}
SENSOR = f"T_BS: {{data: {np.eye(4).ravel().tolist()}}}\nresolution: [6, 4]\nintrinsics: [5, 5, 3, 2]\n"
SHOT = '<camera id="{0}" sensor_id="0" component_id="0" label="{0}"><transform>' + EYE16.replace("\n", " ")
METASHAPE = (
    '<document><chunk><sensors><sensor id="0" type="frame"><resolution width="6" height="4"/><calibration><f>5</f>'
    '<k1>0.1</k1></calibration></sensor></sensors><components><component id="0"><transform><rotation>1 0 0 0 1 0 0 0 1'
    "</rotation><translation>0 0 0</translation><scale>2</scale></transform></component></components><cameras>"
    + "".join(f"{SHOT.format(k)}</transform></camera>" for k in (1, 2))
    + "</cameras></chunk></document>"
)
HEADER = "scene,split,image,x,y,z,qw,qx,qy,qz,time\n"

# Files of a small whole source of each format, and which of them is damaged.
SOURCES: dict[str, tuple[dict[str, str | bytes], tuple[str, ...]]] = {
    "tum_rgbd": (
        {"rgb.txt": "1.0 rgb/1.png\n2.0 rgb/2.png\n", "groundtruth.txt": "1.01 0 0 0 0 0 0 1\n1.99 1 0 0 0 0 0 1\n"}
        | {f"rgb/{k}.png": PICTURE for k in (1, 2)},
        ("rgb.txt", "groundtruth.txt"),
    ),
    "euroc": (
        {
            "mav0/cam0/data.csv": "#timestamp [ns],filename\n1000000000,1.png\n2000000000,2.png\n",
            "mav0/cam0/sensor.yaml": SENSOR
            + "distortion_model: radial-tangential\ndistortion_coefficients: [0.1, 0, 0, 0]\n",
            "mav0/state_groundtruth_estimate0/data.csv": "1000000000,0,0,0,1,0,0,0\n2000000000,1,0,0,1,0,0,0\n",
            "mav0/state_groundtruth_estimate0/sensor.yaml": SENSOR,
        }
        | {f"mav0/cam0/data/{k}.png": PICTURE for k in (1, 2)},
        (
            "mav0/cam0/data.csv",
            "mav0/cam0/sensor.yaml",
            "mav0/state_groundtruth_estimate0/data.csv",
            "mav0/state_groundtruth_estimate0/sensor.yaml",
        ),
    ),
    "kapture": (
        {
            "sensors/sensors.txt": "# kapture format: 1.1\ncam0, , camera, SIMPLE_RADIAL, 6, 4, 5, 3, 2, 0.1\n",
            "sensors/records_camera.txt": "0, cam0, 1.png\n1, cam0, 2.png\n",
            "sensors/trajectories.txt": "0, rig, 1, 0, 0, 0, 0, 0, 0\n1, cam0, 1, 0, 0, 0, 1, 0, 0\n",
            "sensors/rigs.txt": "rig, cam0, 1, 0, 0, 0, 0, 0, 0\n",
        }
        | {f"sensors/records_data/{k}.png": PICTURE for k in (1, 2)},
        tuple(f"sensors/{name}.txt" for name in ("sensors", "records_camera", "trajectories", "rigs")),
    ),
    "tum": ({"a.tum": "1.0 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "1.0.png": PICTURE, "2.png": PICTURE}, ("a.tum",)),
    "kitti": (
        {"poses/00.txt": EYE12 * 2, "sequences/00/times.txt": "0\n1\n", "sequences/00/image_2/000000.png": PICTURE}
        | {"sequences/00/calib.txt": "P0: 5 0 3 0 0 5 2 0 0 0 1 0\nP2: 5 0 3 1 0 5 2 0 0 0 1 0\n"},
        ("poses/00.txt", "sequences/00/calib.txt", "sequences/00/times.txt", "sequences/00/image_2/000000.png"),
    ),
    "kitti_poses": ({"poses.txt": EYE12 * 2, "1.png": PICTURE, "2.png": PICTURE}, ("poses.txt",)),
    "7scenes": (
        {
            "TrainSplit.txt": "sequence1\n",
            "TestSplit.txt": "sequence2\n",
            "camera-intrinsics.txt": "5 0 3\n0 5 2\n0 0 1\n",
        }
        | {f"seq-0{k}/frame-000000.color.png": PICTURE for k in (1, 2)}
        | {f"seq-0{k}/frame-000000.pose.txt": EYE16 for k in (1, 2)}
        | {"seq-01/frame-000000.depth.png": DEPTH},
        ("TrainSplit.txt", "seq-01/frame-000000.pose.txt", "seq-01/frame-000000.depth.png", "camera-intrinsics.txt"),
    ),
    "map_free": (
        {"poses.txt": "seq0/1.png 1 0 0 0 0 0 0\nseq1/2.png 1 0 0 0 1 0 0\n"}
        | {"intrinsics.txt": "seq0/1.png 5 5 3 2 6 4\nseq1/2.png 5 5 3 2 6 4\n"}
        | {f"seq{k - 1}/{k}.png": PICTURE for k in (1, 2)},
        ("poses.txt", "intrinsics.txt"),
    ),
    "scannet": (
        {f"color/{k}.png": PICTURE for k in (1, 2)}
        | {f"pose/{k}.txt": EYE16 for k in (1, 2)}
        | {"intrinsic/intrinsic_color.txt": "5 0 3 0\n0 5 2 0\n0 0 1 0\n0 0 0 1\n"},
        ("pose/1.txt", "intrinsic/intrinsic_color.txt", "color/1.png"),
    ),
    "replica": (
        {"traj.txt": EYE16.replace("\n", " ") + "\n", "results/frame000000.png": PICTURE}
        | {"cam_params.json": json.dumps({"camera": LENS})},
        ("traj.txt", "cam_params.json"),
    ),
    "record3d": ({"metadata": json.dumps(METADATA), "rgbd/0.png": PICTURE, "rgbd/1.png": PICTURE}, ("metadata",)),
    "polycam": (
        {f"keyframes/images/{k}.png": PICTURE for k in (1, 2)}
        | {f"keyframes/cameras/{k}.json": json.dumps(KEYFRAME) for k in (1, 2)},
        ("keyframes/cameras/1.json",),
    ),
    "metashape": ({"a.xml": METASHAPE} | {f"{k}.png": PICTURE for k in (1, 2)}, ("a.xml",)),
    "realityscan": (
        {
            "a.csv": "#name,x,y,alt,heading,pitch,roll,f,px,k1,t1\n1.png,0,0,0,9,80,-9,30,0,0.1,0\n"
            "2.png,1,0,0,0,90,0,30,0,0,0\n"
        }
        | {f"{k}.png": PICTURE for k in (1, 2)},
        ("a.csv",),
    ),
    "pose_lines": (
        {"a.txt": "1.png 1 0 0 0 0 0 0\n2.png 1 0 0 0 1 0 0\n", "1.png": PICTURE, "2.png": PICTURE}
        | {"intrinsics.txt": "1.png 5 5 3 2 6 4\n2.png 5 5 3 2 6 4\n"},
        ("a.txt", "intrinsics.txt"),
    ),
    "pose_files": (
        {f"train/rgb/{k}.color.png": PICTURE for k in (1, 2)}
        | {f"train/poses/{k}.pose.txt": EYE16 for k in (1, 2)}
        | {"train/calibration/1.txt": "5.0\n", "train/calibration/2.txt": "5 0 3\n0 5 2\n0 0 1\n"},
        ("train/poses/1.pose.txt", "train/rgb/1.color.png", "train/calibration/1.txt", "train/calibration/2.txt"),
    ),
    "csv": (
        {"a.csv": HEADER + "den,train,1.png,0,0,0,1,0,0,0,1\nden,test,2.png,1,0,0,1,0,0,0,2\n"}
        | {f"{k}.png": PICTURE for k in (1, 2)},
        ("a.csv",),
    ),
}
TEXT = st.text(st.characters(codec="utf-8"), max_size=60)
WORDS = st.sampled_from(
    [
        *("0", "1", "-1", "nan", "inf", "1e999", "1_0", "0x1", "9" * 5000, "1.0"),
        *("\n", " ", "\t", "#", ",", '"', "\r", "\0", "\u2028", "\ufeff", "\ud7ff"),
        *("../x", "/etc/passwd", "C:\\x", "rgb/1.png", "a" * 300, "P2:", "P2: ", "..", "."),
    ]
).map(str.encode)
NUMBER = st.one_of(
    st.integers(-3, 3), st.floats(), st.just(10**400), st.none(), st.booleans(), TEXT, st.just("\ud800"), st.just(0.5)
)
KEYS = st.sampled_from(sorted({*METADATA, *KEYFRAME, "camera", "perFrameIntrinsicCoeffs", "frameTimestamps", "x"}))
JSON = st.recursive(
    NUMBER,
    lambda inner: st.one_of(st.lists(inner, max_size=9), st.dictionaries(KEYS, inner, max_size=9)),
    max_leaves=20,
)
KEPT = settings(suppress_health_check=list(HealthCheck))


@st.composite
def damaged(draw, whole: bytes) -> bytes:
    """A file in which pieces were cut out, doubled or written over."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(0, 12)))
        piece = draw(st.one_of(st.binary(max_size=8), WORDS, st.just(bytes(data[start:end]) * 2)))
        data[start:end] = piece
    return bytes(data[: draw(st.integers(0, len(data)))]) if draw(st.booleans()) else bytes(data)


def reads_or_refuses(kind: str, changed: dict[str, bytes]) -> None:
    files, _ = SOURCES[kind]
    folder = Path(tempfile.mkdtemp())
    try:
        for name, content in {**files, **changed}.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
        check_reading(kind, folder)
    finally:
        shutil.rmtree(folder)


def check_reading(kind: str, folder: Path) -> None:
    try:
        capture = read_capture(folder, kind)
    except InputError as error:
        message = str(error).encode().decode()  # it can be printed
    else:
        message = ""
        is_finite = np.isfinite(capture.world_from_cam).reshape(len(capture.images), 16)
        assert (is_finite.all(axis=1) | np.isnan(capture.world_from_cam.reshape(-1, 16)).all(axis=1)).all()
        assert all(image.is_file() and image.is_relative_to(folder) for image in capture.images)
        assert capture.time_s is None or np.isfinite(capture.time_s).all()
    assert "\n" not in message


@pytest.mark.parametrize("kind", SOURCES)
def test_the_whole_source_is_read(kind, tmp_path):
    for name, content in SOURCES[kind][0].items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    assert read_capture(tmp_path).kind == kind


@pytest.mark.parametrize(("kind", "file"), [(kind, file) for kind, (_, files) in SOURCES.items() for file in files])
@KEPT
@given(data=st.data())
def test_damaged_files(kind, file, data):
    whole = SOURCES[kind][0][file]
    whole = whole.encode() if isinstance(whole, str) else whole
    content = data.draw(st.one_of(damaged(whole), damaged(whole), st.binary(max_size=200), TEXT.map(str.encode)))
    reads_or_refuses(kind, {file: content})


@pytest.mark.parametrize(
    ("kind", "file"),
    [("record3d", "metadata"), ("polycam", "keyframes/cameras/1.json"), ("replica", "cam_params.json")],
)
@KEPT
@given(data=st.data())
def test_random_json(kind, file, data):
    whole = json.loads(SOURCES[kind][0][file])
    change = data.draw(
        st.one_of(JSON, st.dictionaries(KEYS, JSON, min_size=1, max_size=3).map(lambda part: {**whole, **part}))
    )
    reads_or_refuses(kind, {file: json.dumps(change).encode()})


@pytest.fixture(scope="module")
def colmap(recording, tmp_path_factory):
    """A whole model, binary or text, with its images; and what is in its files."""
    models = pytest.importorskip("colmap_models")
    folders = {}
    for binary in (True, False):
        folder = tmp_path_factory.mktemp("colmap")
        models.write_model(recording, folder, binary, models=("SIMPLE_RADIAL", "OPENCV"))
        recording.write(folder, models.NAMES)
        folders[binary] = folder, {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    return folders


@pytest.mark.parametrize("file", ["cameras", "images", "frames", "rigs", "points3D"])
@pytest.mark.parametrize("binary", [True, False])
@KEPT
@given(data=st.data())
def test_damaged_colmap_models(colmap, binary, file, data):
    """Binary files meet our guard alone: nothing damaged is handed to COLMAP, which believes what they count."""
    folder, whole = colmap[binary]
    loaded = mock.patch("pycolmap.Reconstruction", side_effect=RuntimeError("whole, but not loaded here"))
    name = f"{file}.{'bin' if binary else 'txt'}"
    try:
        (folder / name).write_bytes(data.draw(st.one_of(damaged(whole[name]), st.binary(max_size=200))))
        with loaded if binary else nullcontext():
            check_reading("colmap", folder)
    finally:
        (folder / name).write_bytes(whole[name])


def test_no_text_format_is_left_out():
    named = {name for name in FORMATS if name.endswith(("_world_from_cam", "_cam_from_world"))}
    others = {
        "colmap",
        "structure_from_motion",
        "stray_scanner",
        "nerfstudio",
        "ros_bag",
    }  # which have tests of their own
    assert set(SOURCES) == set(FORMATS) - named - others
