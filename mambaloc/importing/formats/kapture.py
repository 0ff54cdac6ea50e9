"""kapture's text format (1.0 and 1.1), and a dataset of several in ``mapping``, ``validation`` and ``query``.

``sensors/sensors.txt`` has a row a sensor, ``id, name, camera, MODEL, width, height, ...`` with COLMAP's models, whose
pixels count from the image's corner; ``records_camera.txt`` rows ``timestamp, sensor, image`` below ``records_data``;
``trajectories.txt`` rows ``timestamp, device, qw, qx, qy, qz, tx, ty, tz``, world-to-device, where numbers may be left
out; ``rigs.txt`` rows ``rig, sensor, qw, ..., tz``, rig-to-sensor, where a sensor may be another rig. A time stamp may
be a counter. Values stand between commas, and none holds one. Source: ``kapture_format.adoc`` of
github.com/naver/kapture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from mambaloc.data.frames import Split
from mambaloc.errors import InputError
from mambaloc.importing.capture import Capture
from mambaloc.importing.formats.builder import Checked, Matrices, Posed, build_capture, from_quaternions
from mambaloc.importing.formats.finding import find_images
from mambaloc.importing.formats.kapture_cameras import UNKNOWN, unique_cameras
from mambaloc.importing.formats.parsing import as_numbers, folder_name, images_in_same_folders, read_text
from mambaloc.importing.formats.timing import stamps_of

SPLITS: Mapping[str, Split] = {"mapping": "train", "validation": "val", "query": "test"}
"""What frames are for, by the name of their kapture's folder, or of the first folder of their path."""

_FIRST_LINE = "# kapture format:"
_MAX_RIGS = 8  # one on another
_SINCE_1970_S = (5e8, 5e9)  # from 1985 to 2128: other numbers may be counters
_CHOICES = {
    "axes": "OpenCV camera axes, as COLMAP has them",
    "direction": "world-to-device in the file, inverted; sensors of a rig by the rig's pose",
    "scale": "unknown: the format does not state it",
    "origin": "kept",
}

Key = tuple[int, str]
"""A time stamp and a device."""


@dataclass(frozen=True)
class _Record:
    """An image of a kapture, with the row of its pose and what leads from there to the camera; no row where lost."""

    key: Key
    name: str
    where: str
    split: str | None
    row: int | None
    sensor_from_device: Matrices


def is_kapture(source: Path) -> bool:
    """Whether a folder is a kapture, or holds those of a dataset."""
    return bool(_parts(source))


def read_kapture(source: Path, images: Path | None = None) -> Capture:
    """Read a kapture, or all of a dataset.

    Args:
        source: the folder that holds ``sensors``, or ``mapping`` and ``query``.
        images: the folder that the paths of images are relative to; each kapture's ``records_data`` unless given.

    Raises:
        InputError: for a file that is missing or malformed, or where no image has a pose.
    """
    parts = _parts(source)
    if not parts:
        raise InputError(f"{source}: contains no sensors/sensors.txt of kapture; give a folder that does")
    frames: list[tuple[Key, Posed, tuple[str, ...] | None]] = []
    missing: list[str] = []
    beside: list[Path] = []
    choices: dict[str, str] = {}
    for part, split in parts:
        checked, records = _records(part, split)
        root = images or part / "sensors/records_data"
        found = find_images(root, [(record.name, record.where) for record in records])
        sensors = _sensors(part / "sensors/sensors.txt")
        for record, file in sorted(zip(records, found.files, strict=True), key=lambda pair: pair[0].key):
            if file in found.missing:
                missing.append(record.name)
                continue
            beside.append(file)
            if record.row is None:
                continue
            device = checked[record.row]
            world_from_cam = np.linalg.inv(record.sensor_from_device @ device.world_from_cam).astype(np.float64)
            pose = replace(device, world_from_cam=world_from_cam)
            posed_image = Posed(file, _sequence(file, root), pose, split=record.split)
            frames.append((record.key, posed_image, _sensor_of(sensors, record)))
        choices |= {**found.choices, **checked.choices}
    if len({key for key, _, _ in frames}) == len(frames):  # parts of one recording; others may count alike
        frames.sort(key=lambda frame: frame[0])
    names, cameras = unique_cameras([lens for _, _, lens in frames])
    times_s = _times_s([str(stamp) for (stamp, _), _, _ in frames])
    if None in names and any(names):
        choices["cameras"] = f"none: some images are of an {UNKNOWN}"
    return build_capture(
        "kapture",
        source,
        [
            replace(each, camera=name if cameras else None, time_s=time_s)
            for (_, each, _), name, time_s in zip(frames, names, times_s, strict=True)
        ],
        unit="unknown",
        choices={**_CHOICES, **choices},
        cameras=cameras,
        missing=missing,
        beside=images_in_same_folders(beside),
    )


def _parts(source: Path) -> list[tuple[Path, Split | None]]:
    """Folders that hold ``sensors``, and what their frames are for."""
    if _is_part(source):
        return [(source, SPLITS.get(folder_name(source)))]
    return [(source / name, split) for name, split in SPLITS.items() if _is_part(source / name)]


def _is_part(folder: Path) -> bool:
    sensors = folder / "sensors"
    if not all((sensors / name).is_file() for name in ("sensors.txt", "records_camera.txt", "trajectories.txt")):
        return False
    try:
        return read_text(sensors / "sensors.txt", "sensors").startswith(_FIRST_LINE)
    except InputError:
        return False


def _rows(path: Path, columns: Sequence[str], may_be_more: bool = False) -> Iterator[tuple[str, list[str]]]:
    """Where each row is, and its values."""
    for line, text in enumerate(read_text(path, f"rows {', '.join(columns)}").splitlines(), start=1):
        if not text.strip() or text.startswith("#"):
            continue
        words = [word.strip() for word in text.split(",")]
        if len(words) < len(columns) or (len(words) > len(columns) and not may_be_more):
            raise InputError(f"{path}, line {line}: is not a row {', '.join(columns)}; correct or remove it")
        yield f"{path}, line {line}", words


def _sensors(path: Path) -> dict[str, tuple[str, ...]]:
    """Where each camera's row is, its model and its numbers, by id."""
    rows = _rows(path, ("id", "name", "type"), may_be_more=True)
    return {words[0]: (where, *words[3:]) for where, words in rows if words[2] == "camera"}


def _transforms(path: Path) -> tuple[list[list[str]], Checked]:
    """The first two values of each row, and its transform; NaN where numbers are left out."""
    names, numbers, places = [], [], []
    for where, words in _rows(path, ("key", "device", "qw", "qx", "qy", "qz", "tx", "ty", "tz")):
        values = as_numbers([word or "nan" for word in words[2:]])
        if values is None:
            raise InputError(f"{where}: is not a quaternion and translation; correct or remove it")
        names.append(words[:2])
        numbers.append(values)
        places.append(where)
    table = np.array(numbers).reshape(-1, 7)
    return names, from_quaternions(table[:, 4:], table[:, :4], lambda row: places[row])


def _records(part: Path, split: Split | None) -> tuple[Checked, list[_Record]]:
    """Poses of a kapture, and its images."""
    sensors = part / "sensors"
    names, checked = _transforms(sensors / "trajectories.txt")
    row_of = {_key(stamp, device, sensors / "trajectories.txt"): row for row, (stamp, device) in enumerate(names)}
    rigs = _rigs(sensors / "rigs.txt")
    records = []
    for where, (stamp, device, name) in _rows(sensors / "records_camera.txt", ("timestamp", "sensor", "image")):
        key = _key(stamp, device, where)
        row, sensor_from_device = _device(key, row_of, rigs)
        image_split = split or SPLITS.get(PurePosixPath(name.replace("\\", "/")).parts[0] if name else "")
        records.append(_Record(key, name, where, image_split, row, sensor_from_device))
    if not records:
        raise InputError(f"{sensors / 'records_camera.txt'}: names no image; add rows 'timestamp, sensor, image'")
    return checked, records


def _key(stamp: str, device: str, where: str | Path) -> Key:
    try:
        return int(stamp), device
    except ValueError:
        raise InputError(f"{where}: time stamp {stamp[:40]!r} is not an integer; correct it") from None


def _rigs(path: Path) -> dict[str, list[tuple[str, Matrices]]]:
    """Of each sensor the rigs that carry it, and ``sensor_from_rig``."""
    carriers: dict[str, list[tuple[str, Matrices]]] = {}
    if path.is_file():
        names, checked = _transforms(path)
        for (rig, sensor), pose in zip(names, checked.poses, strict=True):
            carriers.setdefault(sensor, []).append((rig, pose))
    return carriers


def _device(
    key: Key, row_of: Mapping[Key, int], rigs: Mapping[str, list[tuple[str, Matrices]]]
) -> tuple[int | None, Matrices]:
    """The row of the pose of a sensor, or else of the nearest rig that carries it, and what leads from that to it."""
    stamp, sensor = key
    reached = [(sensor, np.eye(4))]
    for _ in range(_MAX_RIGS):
        for device, sensor_from_device in reached:
            if (stamp, device) in row_of:
                return row_of[stamp, device], sensor_from_device
        reached = [
            (rig, sensor_from_device @ device_from_rig)
            for device, sensor_from_device in reached[:_MAX_RIGS]
            for rig, device_from_rig in rigs.get(device, ())
        ]
    return None, np.eye(4)


def _sensor_of(sensors: Mapping[str, tuple[str, ...]], record: _Record) -> tuple[str, ...] | None:
    """Where an image's camera is, its model and its numbers; None for one that is not calibrated."""
    sensor = sensors.get(record.key[1])
    if sensor is None:
        raise InputError(f"{record.where}: sensor {record.key[1][:40]!r} is not a camera of sensors.txt; add it there")
    return None if sensor[1:2] == (UNKNOWN,) else sensor


def _times_s(stamps: Sequence[str]) -> list[float | None]:
    """Seconds, where time stamps are times since 1970; they may be counters else."""
    times = stamps_of(stamps)
    if times is None or not all(_SINCE_1970_S[0] <= time_s < _SINCE_1970_S[1] for time_s in times.seconds):
        return [None] * len(stamps)
    return times.seconds.tolist()


def _sequence(image: Path, root: Path) -> str:
    parent = image.parent.relative_to(root).as_posix()
    return parent if parent != "." else "records_data"
