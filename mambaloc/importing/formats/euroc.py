"""Recordings in the ASL layout of the EuRoC MAV datasets, which TUM-VI and visual-inertial tools write, too.

``mav0/cam0/data.csv`` has rows ``timestamp [ns], filename`` of ``cam0/data``; ``cam0/sensor.yaml`` has ``T_BS``, the
sensor's pose in the body's frame (row after row), ``intrinsics`` fu, fv, cu, cv in OpenCV's pixels, and the lens:
``radial-tangential`` is OpenCV's k1, k2, p1, p2, ``equidistant`` its fisheye.
``mav0/state_groundtruth_estimate0/data.csv`` has rows ``timestamp [ns], p_RS_R, q_RS, ...``: position and orientation,
scalar first, of a sensor S in the reference frame R, in metres. Its own ``sensor.yaml`` says where S is on the body;
the identity unless it does. So ``world_from_cam = world_from_S @ inv(body_from_S) @ body_from_cam``. TUM-VI calls the
folder ``mocap0``. Source: Burri et al. 2016, "The EuRoC micro aerial vehicle datasets", and the recordings' own files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mambaloc.errors import InputError
from mambaloc.files import parse_yaml
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.formats.builder import Matrices, Posed, build_capture, from_quaternions, pinhole, validate_se3
from mambaloc.importing.formats.finding import find_images
from mambaloc.importing.formats.parsing import (
    Table,
    array_of,
    as_numbers,
    folder_name,
    images_in_same_folders,
    read_text,
)
from mambaloc.importing.formats.timing import by_time, stamps_of
from mambaloc.runtime.camera_models import FisheyeModel, OpenCVModel

_TRUTHS = ("state_groundtruth_estimate0", "mocap0")
_POSE = ("p_rs_r_x", "p_rs_r_y", "p_rs_r_z", "q_rs_w", "q_rs_x", "q_rs_y", "q_rs_z")
_LENSES = {
    "radial-tangential": (OpenCVModel, (4, 5)),
    "radtan": (OpenCVModel, (4, 5)),  # Kalibr's word
    "plumb_bob": (OpenCVModel, (4, 5)),  # ROS's
    "equidistant": (FisheyeModel, (4,)),
}
"""How rays are distorted, by the file's word, with how many coefficients."""
_OPENCVS_DIRECTIVE = "%YAML:1.0"
"""Which its ``FileStorage`` begins with, and YAML spells with a space."""
_NO_LENS = (None, "none", "None", "")
_CHOICES = {
    "axes": "OpenCV camera axes: the ground truth's body, turned and shifted to the camera by T_BS of its sensor.yaml",
    "direction": "sensor-to-world, scalar first, as the format has it",
    "scale": "metres, as the format has them",
    "origin": "kept",
}


def is_euroc(source: Path) -> bool:
    """Whether a source is a recording, or its ``mav0``: a camera with its calibration, and a ground truth."""
    folder = _mav0(source)
    has_camera = (folder / "cam0/data.csv").is_file() and (folder / "cam0/sensor.yaml").is_file()
    return has_camera and any((folder / name / "data.csv").is_file() for name in _TRUTHS)


def read_euroc(source: Path, images: Path | None = None) -> Capture:
    """Read the first camera of a recording: one of a stereo pair sees what a place looks like.

    Args:
        source: the recording's folder, or ``mav0``.
        images: the folder of the images; ``cam0/data`` unless given.

    Raises:
        InputError: for a file that is missing or damaged, a lens that is not known, or where no time stamps meet.
    """
    folder = _mav0(source)
    truth = next((folder / name for name in _TRUTHS if (folder / name / "data.csv").is_file()), folder / _TRUTHS[0])
    table = _poses(truth / "data.csv")
    listing = folder / "cam0/data.csv"
    listed = _rows(listing, "rows timestamp, filename")
    short = next((line for line, row in listed if len(row) < 2 or stamps_of(row[:1]) is None), None)
    if short is not None or not listed:
        raise InputError(f"{listing}, line {short or 1}: is not a row 'timestamp, filename'; correct or remove it")
    camera, body_from_cam = _camera(folder / "cam0/sensor.yaml")
    found = find_images(images or listing.parent / "data", [(row[1], f"{listing}, line {n}") for n, row in listed])
    there = [row for row, file in enumerate(found.files) if file not in found.missing]
    stamps = stamps_of([listed[row][1][0] for row in there])
    if stamps is None:
        raise InputError(f"{listing}: has time stamps in an unknown unit; correct them")
    pairs, how = by_time(listing, stamps, table.words, table.path)
    checked = from_quaternions(table.numbers[:, :3], table.numbers[:, 3:], table.where)
    sensor_from_cam = np.linalg.inv(_body_from_sensor(truth / "sensor.yaml")) @ body_from_cam
    posed_cam = checked @ sensor_from_cam
    name = folder_name(folder.parent if source == folder else source)
    posed = [
        Posed(
            found.files[there[at]],
            name,
            posed_cam[row],
            "cam0",
            float(stamps.seconds[at]),
        )
        for at, row in pairs
    ]
    others = sorted(each.name for each in folder.glob("cam*") if each.name != "cam0")
    return build_capture(
        "euroc",
        source,
        sorted(posed, key=lambda each: each.time_s or 0.0),
        unit="metre",
        choices={
            **_CHOICES,
            "ground truth": truth.name,
            "association": "; ".join(filter(None, (how, found.elsewhere))),
            **({"not read": f"{', '.join(others)}: the other cameras of the rig"} if others else {}),
            **checked.choices,
        },
        cameras={"cam0": camera},
        missing=[listed[row][1][1] for row, file in enumerate(found.files) if file in found.missing],
        beside=images_in_same_folders(found.files[row] for row in there),
    )


def _mav0(source: Path) -> Path:
    return source / "mav0" if (source / "mav0").is_dir() else source


def _rows(path: Path, holds: str) -> list[tuple[int, list[str]]]:
    """Words between commas of each line that is not a comment, with its number."""
    lines = enumerate(read_text(path, holds).splitlines(), start=1)
    return [
        (number, [word.strip() for word in line.split(",")])
        for number, line in lines
        if line.strip(" ,") and not line.lstrip().startswith("#")
    ]


def _poses(path: Path) -> Table:
    """Positions (N, 3) and quaternions (N, 4), scalar first; ``words`` are time stamps. Zeros and NaN are kept."""
    rows = _rows(path, "rows timestamp, p_RS_R_x, ..., q_RS_w, ...")
    header = next((line for line in read_text(path, "poses").splitlines() if line.startswith("#")), "")
    named = tuple(word.partition("[")[0].strip().lower() for word in header.split(",")[1:8])
    if header and named != _POSE:
        raise InputError(
            f"{path}, line 1: names the columns {', '.join(named)[:120]!r}, not {', '.join(_POSE)}. Write the position "
            "and the quaternion, scalar first, after the time stamp."
        )
    numbers = np.empty((len(rows), len(_POSE)))
    for at, (line, words) in enumerate(rows):
        values = as_numbers(words[1:8])
        if values is None or len(values) != len(_POSE):
            raise InputError(f"{path}, line {line}: is not a row of a time stamp and 7 numbers; correct or remove it")
        numbers[at] = values
    if not rows:
        raise InputError(f"{path}: has no pose; give a recording with a ground truth")
    return Table(path, tuple(line for line, _ in rows), tuple(words[0] for _, words in rows), numbers)


def _sensor(path: Path) -> Mapping[str, Any]:
    text = read_text(path, "the calibration of a sensor").removeprefix(_OPENCVS_DIRECTIVE)
    content = parse_yaml(text, path, "give the recording's own")
    if not isinstance(content, Mapping):
        raise InputError(f"{path}: contains no calibration of a sensor; give the recording's own")
    return content


def _transform(content: Mapping[str, Any], path: Path) -> Matrices:
    value = content.get("T_BS")
    rows = value.get("data") if isinstance(value, Mapping) else value
    matrix = array_of(np.ravel(rows).tolist() if isinstance(rows, list) else rows, (16,), "T_BS", path).reshape(4, 4)
    (pose,) = validate_se3(matrix[None], lambda _: f"{path}: T_BS").poses
    if np.isnan(pose).any():  # a mark of no fix, which no calibration has
        raise InputError(f"{path}: T_BS is not a rotation and translation; give the recording's own")
    return pose


def _body_from_sensor(path: Path) -> Matrices:
    """Where the sensor that the ground truth is of is on the body: there itself where no file says."""
    content = _sensor(path) if path.is_file() else {}
    return _transform(content, path) if content.get("T_BS") is not None else np.eye(4)


def _camera(path: Path) -> tuple[Camera, Matrices]:
    """A camera, and its pose on the body."""
    content = _sensor(path)
    size: Sequence[float] = array_of(content.get("resolution"), (2,), "resolution", path).tolist()
    fu, fv, cu, cv = array_of(content.get("intrinsics"), (4,), "intrinsics", path).tolist()
    camera = pinhole(size, (fu, fv), (cu, cv), path)
    body_from_cam, model = _transform(content, path), content.get("distortion_model")
    if content.get("camera_model", "pinhole") != "pinhole":
        raise InputError(
            f"{path}: camera_model {str(content['camera_model'])[:40]!r} is not read, only pinhole; calibrate it so"
        )
    listed = content.get("distortion_coefficients") or []
    if model in _NO_LENS and not listed:
        return camera, body_from_cam
    if not isinstance(model, str) or model not in _LENSES:
        raise InputError(
            f"{path}: distortion_model {str(model)[:40]!r} is not one of {', '.join(_LENSES)}; calibrate it so"
        )
    lens, counts = _LENSES[model]
    coefficients = array_of(listed, (None,), "distortion_coefficients", path).tolist()
    if len(coefficients) not in counts:
        raise InputError(
            f"{path}: has {len(coefficients)} distortion_coefficients, {model} has {counts[0]}; correct it"
        )
    return replace(camera, distorted=lens(camera.focal_px, camera.center_px, coefficients), model=model), body_from_cam
