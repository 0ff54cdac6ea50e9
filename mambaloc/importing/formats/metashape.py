"""Cameras that Agisoft Metashape exports as XML (File, Export, Export Cameras), or PhotoScan since 1.2.

A chunk has sensors with a calibration in pixels, where cx and cy count from the middle of the image
(:mod:`mambaloc.importing.formats.photogrammetric_lens`), and cameras with a transform: 4x4, camera-to-chunk, row after
row, in OpenCV's axes. The chunk's own transform, or that of the component that a camera is of, has a rotation, a
translation and a scale, and leads to the world: metres of the local coordinate system, or of geocentric ones where the
chunk has another. A camera that was not aligned has no transform. Labels are the images' names, with or without a
suffix. Source: "Camera models" and ``Chunk.transform`` of Metashape's manual and Python reference; exports that others
read (``metashape_utils.py`` of nerfstudio, ``derived_cameras.py`` of geograypher, EasyIDP).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.formats.builder import Matrices, Posed, build_capture, pinhole, validate_se3
from mambaloc.importing.formats.finding import find_images
from mambaloc.importing.formats.parsing import as_numbers, folder_name, images_in_same_folders, only_file, read_xml
from mambaloc.importing.formats.photogrammetric_lens import photogrammetric_lens

_BEGINNING = 4096  # bytes
_FISHEYES = ("fisheye", "equidistant_fisheye")
_NO = ("false", "0")
_DISABLED = "disabled in Metashape"


def is_metashape(source: Path) -> bool:
    """Whether a source is such a file, or a folder that holds one, by what the files begin with."""
    return bool(_files(source))


def read_metashape(source: Path, images: Path | None = None) -> Capture:
    """Read the aligned cameras of the chunk, and the component of it, that has most aligned cameras.

    Args:
        source: the file, or its folder.
        images: the folder of the images; found below the file's by their names unless given.

    Raises:
        InputError: for a file that is malformed, a camera that cannot be one, or where no image is there.
    """
    path = only_file(_files(source), source)
    chunk, not_read = _largest_chunk(path)
    aligned = [camera for camera in chunk.iterfind("cameras//camera") if camera.find("transform") is not None]
    if not aligned:
        raise InputError(f"{path}: no camera is aligned; align the photos, and export the cameras again")
    component, count = Counter(camera.get("component_id") for camera in aligned).most_common(1)[0]
    cameras = [camera for camera in aligned if camera.get("component_id") == component]
    if len(aligned) > count:
        not_read.append(f"{len(aligned) - count} cameras of other components, which were aligned apart")
    labels = [camera.get("label") or "" for camera in cameras]
    folder = images or path.parent
    found = find_images(folder, [(label, f"{path}: camera {label[:60]!r}") for label in labels])
    there = [row for row, file in enumerate(found.files) if file not in found.missing]
    own = next((each for each in chunk.iterfind("components/component") if each.get("id") == component), None)
    transform = None if own is None else own.find("transform")
    transform = chunk.find("transform") if transform is None else transform
    poses, malformed = _to_chunk(path, cameras)
    checked = validate_se3(poses, lambda row: f"{path}: camera {labels[row][:60]!r}")
    world = checked.poses if transform is None else _to_world(path, transform, checked.poses)
    checked = replace(checked, poses=world, faults={**malformed, **checked.faults})
    enabled = [row for row in there if cameras[row].get("enabled", "true").lower() not in _NO]
    lenses = {f"sensor-{number}": _sensor(path, chunk, number) for number in _used(cameras, enabled)}
    is_metric = transform is not None and _has_references(chunk)
    return build_capture(
        "metashape",
        path,
        [
            Posed(
                found.files[row],
                _sequence(found.files[row], folder),
                checked[row],
                f"sensor-{cameras[row].get('sensor_id')}",
            )
            for row in enabled
        ],
        unit="metre" if is_metric else "unknown",
        choices={
            "axes": "OpenCV camera axes, as Metashape has them",
            "direction": "camera-to-chunk, as the format has it, and the chunk's transform to the world",
            "scale": "metres, by the chunk's references" if is_metric else "unknown: the chunk has no references",
            "origin": "kept",
            **({"not read": "; ".join(not_read)} if not_read else {}),
            **found.choices,
            **checked.choices,
        },
        cameras=lenses,
        missing=[labels[row] for row, file in enumerate(found.files) if file in found.missing],
        beside=images_in_same_folders(found.files[row] for row in there),
        left_out={found.files[row]: _DISABLED for row in there if row not in set(enabled)},
    )


def _files(source: Path) -> list[Path]:
    """The files of a source that begin as such documents do."""
    files = [source] if source.is_file() else sorted(source.glob("*.xml")) if source.is_dir() else []
    return [file for file in files if file.suffix.lower() == ".xml" and file.is_file() and _is_document(file)]


def _is_document(file: Path) -> bool:
    try:
        with file.open("rb") as opened:
            beginning = opened.read(_BEGINNING).replace(b"\0", b"")  # of UTF-16
    except OSError:
        return False
    return b"<document" in beginning and b"<chunk" in beginning


def _largest_chunk(path: Path) -> tuple[Element, list[str]]:
    """The chunk with most aligned cameras, and what is not read for it."""
    chunks = read_xml(path, "the cameras of a chunk of Metashape").findall("chunk")
    if not chunks:
        raise InputError(f"{path}: contains no chunk; export the cameras again")
    counts = [len(chunk.findall("cameras//camera/transform")) for chunk in chunks]
    best = counts.index(max(counts))
    others = [chunk.get("label") or "unnamed" for at, chunk in enumerate(chunks) if at != best]
    return chunks[best], [f"the chunks {', '.join(others)[:120]}"] if others else []


def _to_chunk(path: Path, cameras: Sequence[Element]) -> tuple[Matrices, dict[int, str]]:
    """Each camera's transform (N, 4, 4), NaN where it is malformed, and why by row."""
    poses, faults = np.full((len(cameras), 4, 4), np.nan), {}
    for row, camera in enumerate(cameras):
        values = _numbers(camera, "transform")
        if values is not None and len(values) == 16:
            poses[row] = values.reshape(4, 4)
        else:
            faults[row] = f"{path}: camera {(camera.get('label') or '')[:60]!r}: transform is not a 4x4 matrix"
    return poses, faults


def _to_world(path: Path, transform: Element, poses: Matrices) -> Matrices:
    """Poses in a chunk as ``world_from_cam``."""
    parts = [_numbers(transform, name) for name in ("rotation", "translation", "scale")]
    rotation, translation, scale = (np.zeros(0) if each is None else each for each in parts)
    is_complete = (len(rotation), len(translation), len(scale)) == (9, 3, 1)
    if not is_complete or not np.isfinite([*translation, *scale]).all() or not 1e-9 < scale[0] < 1e9:
        raise InputError(f"{path}: the chunk's transform is not a rotation, translation and scale; export it again")
    matrix = np.c_[rotation.reshape(3, 3), translation]
    (turned,) = validate_se3(matrix[None], lambda _: f"{path}: the chunk's transform").poses
    if np.isnan(turned).any():
        raise InputError(f"{path}: the chunk's transform has no rotation; export it again")
    scaled = poses.copy()
    scaled[:, :3, 3] *= scale[0]
    return turned @ scaled


def _numbers(parent: Element, name: str) -> Matrices | None:
    """The numbers of a child; None without it, or if it has no numbers."""
    text = parent.findtext(name)
    return None if text is None else as_numbers(text.split())


def _has_references(chunk: Element) -> bool:
    """Whether anything was measured: a camera's or a marker's place, or a scale bar's length."""
    return any({"x", "distance"}.intersection(each.keys()) for each in chunk.iter("reference"))


def _used(cameras: Sequence[Element], rows: Sequence[int]) -> list[str]:
    return list(dict.fromkeys(str(cameras[row].get("sensor_id")) for row in rows))


def _sensor(path: Path, chunk: Element, number: str) -> Camera:
    """The camera of a sensor, by its adjusted calibration where there are several."""
    where = f"{path}: sensor {number[:20]}"
    sensor = next((each for each in chunk.iterfind("sensors/sensor") if each.get("id") == number), None)
    calibrations = [] if sensor is None else sensor.findall("calibration")
    if sensor is None or not calibrations:
        raise InputError(f"{where}: has no calibration; align the photos, and export the cameras again")
    calibration = next((each for each in calibrations if each.get("class") == "adjusted"), calibrations[0])
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", *_FISHEYES):
        raise InputError(f"{where}: is {kind[:40]!r}, not a frame or fisheye camera; export undistorted photos")
    params = {}
    for name in ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"):
        values = _numbers(calibration, name) if calibration.find(name) is not None else np.zeros(1)
        if values is None or len(values) != 1 or not abs(values[0]) < 1e9:
            raise InputError(f"{where}: {name} is not a number; export the cameras again")
        params[name] = float(values[0])
    size = _size(calibration.find("resolution"), sensor.find("resolution"))
    focal, affinity = params["f"], (params["b1"], params["b2"])
    center = [side / 2 + params[name] - CORNER_PX for side, name in zip(size, ("cx", "cy"), strict=True)]
    camera = pinhole(size, (focal + affinity[0], focal), center, where)
    radial, tangential = ([params[f"{letter}{n}"] for n in (1, 2, 3, 4)] for letter in "kp")
    is_fisheye = kind in _FISHEYES
    if not any((*radial, *tangential, affinity[1], is_fisheye)):
        return camera
    lens = photogrammetric_lens(focal, camera.center_px, radial, tangential, affinity, is_fisheye)
    return replace(camera, distorted=lens, model=f"Metashape's {kind}")


def _size(*resolutions: Element | None) -> list[float]:
    for each in resolutions:
        values = None if each is None else as_numbers([each.get("width", ""), each.get("height", "")])
        if values is not None and np.isfinite(values).all():
            return values.tolist()
    return [0.0, 0.0]


def _sequence(image: Path, folder: Path) -> str:
    parent = image.parent.relative_to(folder)
    return parent.as_posix() if parent.name else folder_name(folder)
