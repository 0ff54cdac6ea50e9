"""What iPhone apps export of ARKit's poses: Record3D and Polycam.

ARKit's camera looks along -z with y up, as OpenGL's does, in metres in a world whose y is up; its principal point is
counted from the top-left **corner** of the image (Apple, ``ARCamera.transform`` and ``ARCamera.intrinsics``).

Record3D (an unpacked ``.r3d``): ``metadata`` or ``metadata.json`` with ``poses``, a row ``qx qy qz qw tx ty tz`` each,
camera-to-world in OpenGL's axes; ``K``, 3x3 of the first frame column after column; ``w`` and ``h``; perhaps
``perFrameIntrinsicCoeffs``, rows ``fx fy cx cy``, and ``frameTimestamps``. Frame N is ``rgbd/N.jpg``. Source: its
author's answers (github.com/marek-simonik/record3d, issues 27, 36, 63, 64), ``record3d2nerf.py`` of instant-ngp, and
nerfstudio. The world is that of the first camera, whatever way it was held (issue 27).

Polycam (raw data): ``keyframes/cameras/STAMP.json`` with ``t_00`` to ``t_23``, the rows of a camera-to-world matrix,
``fx fy cx cy width height``, and ``keyframes/images/STAMP.jpg``; better ``corrected_cameras`` and ``corrected_images``
once the app has optimised them, where some versions leave width and height to ``cameras`` or to the image. STAMP is in
microseconds. Source: the readme of github.com/PolyCam/polyform.

ARCore: no app is known whose export of images with poses is common and documented, so there is no reader.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX, list_images, read_image
from mambaloc.importing.capture import OPENCV_FROM_OPENGL, Camera, Capture
from mambaloc.importing.formats.builder import (
    Posed,
    build_capture,
    from_quaternions,
    pinhole,
    validate_se3,
)
from mambaloc.importing.formats.parsing import array_of, first_with_images, folder_name, number_of, read_object
from mambaloc.text import natural

_OFF_CENTER = 0.05
_CHOICES = {
    "axes": "ARKit's camera axes (y up, looking along -z) turned to OpenCV's; the world is kept",
    "direction": "camera-to-world, as the format has it",
    "scale": "metres, as ARKit has them",
    "origin": "kept: where the recording began",
}


def is_record3d(source: Path) -> bool:
    """Whether a source is a Record3D recording."""
    has_images = (source / "rgbd").is_dir() or (source / "rgb").is_dir()
    return source.suffix == ".r3d" or (_metadata(source).is_file() and has_images)


def read_record3d(source: Path) -> Capture:
    """Read a recording of the LiDAR camera.

    Raises:
        InputError: for a file that is missing or damaged, or a recording of the selfie camera, which has no poses.
    """
    if source.is_file():
        raise InputError(f"{source}: is an archive; unpack it (unzip {source.name} -d FOLDER) and give the folder")
    path = _metadata(source)
    metadata = read_object(path, "poses, K, w and h of a Record3D recording")
    rows = array_of(metadata.get("poses"), (None, 7), "poses", path, may_lack_fix=True)
    if len(rows) > 1 and not np.ptp(rows, axis=0).any():
        raise InputError(f"{path}: all {len(rows)} poses are the same; record with the LiDAR camera, which is tracked")
    quaternion = np.roll(rows[:, :4], 1, axis=1)
    checked = from_quaternions(rows[:, 4:], quaternion, lambda row: f"{path}: poses, row {row}")
    checked @= OPENCV_FROM_OPENGL
    folder = first_with_images([source / "rgbd", source / "rgb"])
    images = list_images(folder)
    numbered = {number_of(image): image for image in images}
    names, cameras = distinguish_cameras(_record3d_cameras(metadata, path, len(rows)))
    stamps = metadata.get("frameTimestamps")
    times = [None] * len(rows) if stamps is None else array_of(stamps, (len(rows),), "frameTimestamps", path).tolist()
    sequence = folder_name(source)
    present = [row for row in range(len(rows)) if row in numbered]
    return build_capture(
        "record3d",
        source,
        [Posed(numbered[row], sequence, checked[row], names[row], times[row]) for row in present],
        unit="metre",
        choices={**_CHOICES, **checked.choices},
        cameras=cameras,
        missing=[f"{folder.name}/{row}{images[0].suffix}" for row in range(len(rows)) if row not in numbered],
        beside=images,
    )


def is_polycam(source: Path) -> bool:
    """Whether a folder is Polycam's raw data, or ``keyframes`` of it."""
    return _polycam_folders(source) is not None


def read_polycam(source: Path) -> Capture:
    """Read optimised poses with their undistorted images, or ARKit's own without optimised ones.

    Raises:
        InputError: for a file that is missing or damaged.
    """
    folders = _polycam_folders(source)
    files = sorted(folders[0].glob("*.json"), key=natural) if folders else []
    if folders is None or not files:
        raise InputError(f"{source}: has no keyframes/cameras/STAMP.json; export 'raw data' in developer mode")
    images = {image.stem: image for image in list_images(folders[1])}
    sequence, present = folder_name(source), [file for file in files if file.stem in images]
    read = [_polycam_frame(file, images[file.stem]) for file in present]
    matrices = np.array([matrix for matrix, _ in read]).reshape(-1, 3, 4)
    checked = validate_se3(matrices, lambda row: str(present[row])) @ OPENCV_FROM_OPENGL
    names, cameras = distinguish_cameras([camera for _, camera in read])
    stamps = all(number_of(file) >= 0 for file in present)
    posed = [
        Posed(
            images[file.stem],
            sequence,
            checked[row],
            names[row],
            number_of(file) / 1e6 if stamps else None,
        )
        for row, file in enumerate(present)
    ]
    return build_capture(
        "polycam",
        source,
        posed,
        unit="metre",
        choices={
            **_CHOICES,
            "poses": _polycam_poses(folders[0], len(files)),
            **checked.choices,
        },
        cameras=cameras,
        missing=[f"{folders[1].name}/{file.stem}.jpg" for file in files if file.stem not in images],
        beside=images.values(),
    )


def _metadata(source: Path) -> Path:
    return source / "metadata" if (source / "metadata").is_file() else source / "metadata.json"


def _record3d_cameras(metadata: dict[str, object], path: Path, count: int) -> list[Camera]:
    """The camera of each of so many frames."""
    size = array_of([metadata.get("w"), metadata.get("h")], (2,), "w, h", path).tolist()
    if metadata.get("perFrameIntrinsicCoeffs") is not None:
        rows = array_of(metadata["perFrameIntrinsicCoeffs"], (count, 4), "perFrameIntrinsicCoeffs", path)
    else:
        fx, _, _, _, fy, _, cx, cy, _ = array_of(metadata.get("K"), (9,), "K", path)
        rows = np.tile((fx, fy, cx, cy), (count, 1))
    return [pinhole(size, (fx, fy), (cx - CORNER_PX, cy - CORNER_PX), path) for fx, fy, cx, cy in rows.tolist()]


def distinguish_cameras(cameras: list[Camera]) -> tuple[list[str], dict[str, Camera]]:
    """A name for each camera, the same for equal ones, and the cameras by name."""
    names = {camera: f"camera-{number}" for number, camera in enumerate(dict.fromkeys(cameras))}
    return [names[camera] for camera in cameras], {name: camera for camera, name in names.items()}


def _polycam_folders(source: Path) -> tuple[Path, Path] | None:
    """The best of the folders of cameras, and that of their images."""
    for parent in (source / "keyframes", source):
        for prefix in ("corrected_", ""):
            cameras, images = parent / f"{prefix}cameras", parent / f"{prefix}images"
            if cameras.is_dir() and images.is_dir():
                return cameras, images
    return None


def _polycam_poses(cameras: Path, count: int) -> str:
    """Which of an export's poses were taken, and which were not."""
    raw, corrected = (cameras.with_name(f"{prefix}cameras") for prefix in ("", "corrected_"))
    if cameras == corrected:
        others = sum(not (corrected / file.name).is_file() for file in raw.glob("*.json"))
        return f"{count} optimised by the app" + (f"; not read: {others} that it did not optimise" if others else "")
    if corrected.is_dir():
        return "ARKit's own: corrected_cameras are of corrected_images, which are missing"
    return "ARKit's own: the app optimised none"


def _polycam_frame(path: Path, image: Path) -> tuple[np.ndarray, Camera]:
    """The matrix of a file, in ARKit's axes, and the camera of it and its image."""
    frame = read_object(path, "a camera of Polycam")
    keys = [f"t_{row}{column}" for row in range(3) for column in range(4)]
    matrix = array_of([frame.get(key) for key in keys], (12,), "t_00 to t_23", path)
    fx, fy, cx, cy = array_of([frame.get(key) for key in ("fx", "fy", "cx", "cy")], (4,), "fx, fy, cx, cy", path)
    size = _polycam_size(frame, (cx, cy), path, image)
    return matrix, pinhole(size, (fx, fy), (cx - CORNER_PX, cy - CORNER_PX), path)


def _polycam_size(frame: dict[str, object], center: Sequence[float], path: Path, image: Path) -> list[float]:
    """Width and height that a camera is given for: its own, those of the uncorrected camera, or its image's.

    That of the one that was not corrected counts where the principal point is about its middle: correcting may crop.
    """
    raw = path.parent.with_name(path.parent.name.removeprefix("corrected_")) / path.name
    for file in dict.fromkeys((path, raw)):
        content = frame if file == path else read_object(file, "a camera of Polycam") if file.is_file() else {}
        sides = [content.get("width"), content.get("height")]
        if sides == [None, None]:
            continue
        size = array_of(sides, (2,), "width, height", file).tolist()
        if file == path or all(abs(at - side / 2) <= _OFF_CENTER * side for at, side in zip(center, size, strict=True)):
            return size
    height, width = read_image(image).shape[:2]
    return [float(width), float(height)]
