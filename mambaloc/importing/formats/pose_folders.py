"""Poses in text files beside image folders: as ScanNet's reader exports them, and as NICE-SLAM lays out Replica.

ScanNet: ``color/N.jpg`` with ``pose/N.txt``, a 4x4 camera-to-world matrix in metres that is infinite where tracking was
lost, and ``intrinsic/intrinsic_color.txt``, 4x4. Source: ``export_poses`` of SensReader (Dai et al. 2017,
github.com/ScanNet/ScanNet).

Replica: ``results/frameNNNNNN.jpg`` with ``traj.txt``, a 4x4 camera-to-world matrix a line in metres, and
``cam_params.json`` beside it or one folder up. Source: NICE-SLAM (Zhu et al. 2022), whose loaders turn both formats' y
and z axes around to come to OpenGL's, so that they are OpenCV's here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import list_images, stored_size
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.formats.builder import Matrices, Posed, build_capture, pinhole, validate_se3
from mambaloc.importing.formats.parsing import (
    array_of,
    as_numbers,
    folder_name,
    number_of,
    read_object,
    read_table,
    read_text,
)
from mambaloc.text import natural

_CHOICES = {
    "axes": "OpenCV camera axes, as the format has them",
    "direction": "camera-to-world, as the format has it",
    "scale": "metres, as the format has them",
    "origin": "kept",
}
_MATRIX = "the 16 numbers of a 4x4 camera-to-world matrix"


def is_scannet(source: Path) -> bool:
    """Whether a folder, or ``frames`` in it, is an exported ScanNet recording."""
    return _scannet_folder(source) is not None


def read_scannet(source: Path) -> Capture:
    """Read an exported recording; images whose pose is infinite are left without one, and counted.

    Raises:
        InputError: for a file that is missing or damaged.
    """
    folder = _scannet_folder(source) or source
    images = {image.stem: image for image in list_images(folder / "color")}
    files = sorted((folder / "pose").glob("*.txt"), key=natural) if (folder / "pose").is_dir() else []
    if not images or not files:
        raise InputError(
            f"{source}: has no images in {folder / 'color'}, or no NAME.txt in {folder / 'pose'}; add them"
        )
    matrices = {file: _read_matrix(file) for file in files}
    tracked = [file for file, matrix in matrices.items() if np.isfinite(matrix).all()]
    if not tracked:
        raise InputError(f"{folder / 'pose'}: all {len(files)} poses are infinite or NaN; record again")
    checked = validate_se3(np.stack([matrices[file] for file in tracked]), lambda row: str(tracked[row]))
    camera = _scannet_camera(folder / "intrinsic" / "intrinsic_color.txt", next(iter(images.values())))
    name = folder_name(source)
    camera_name = None if camera is None else "color"
    posed = [
        Posed(images[file.stem], name, checked[row], camera_name)
        for row, file in enumerate(tracked)
        if file.stem in images
    ]
    return build_capture(
        "scannet",
        source,
        posed,
        unit="metre",
        choices={
            **_CHOICES,
            "lost": f"{len(files) - len(tracked)} of {len(files)} poses are infinite: left out",
            **checked.choices,
        },
        cameras={} if camera is None else {"color": camera},
        missing=[f"color/{file.stem}" for file in files if file.stem not in images],
        beside=images.values(),
    )


def is_replica(source: Path) -> bool:
    """Whether a folder is a Replica scene as NICE-SLAM lays it out."""
    return (source / "traj.txt").is_file() and (source / "results").is_dir()


def read_replica(source: Path) -> Capture:
    """Read ``traj.txt``, whose line N is ``frameN``'s.

    Raises:
        InputError: for a file that is missing or damaged.
    """
    table = read_table(source / "traj.txt", 16, _MATRIX, may_lack_fix=True)
    checked = validate_se3(table.numbers.reshape(-1, 4, 4), table.where)
    images = [image for image in list_images(source / "results") if image.name.startswith("frame")]
    numbered = {number_of(image): image for image in images}
    camera = _replica_camera(source)
    name = folder_name(source)
    posed, missing = [], []
    for row in range(len(checked.poses)):
        if row in numbered:
            posed.append(Posed(numbered[row], name, checked[row], None if camera is None else "frame"))
        else:
            missing.append(f"results/frame{row:06d}")
    cameras = {} if camera is None else {"frame": camera}
    choices = {**_CHOICES, **checked.choices}
    return build_capture(
        "replica", source, posed, unit="metre", choices=choices, cameras=cameras, missing=missing, beside=images
    )


def _scannet_folder(source: Path) -> Path | None:
    for folder in (source, source / "frames"):
        if (folder / "color").is_dir() and (folder / "pose").is_dir():
            return folder
    return None


def _read_matrix(path: Path) -> Matrices:
    """A 4x4 matrix, not all of it finite perhaps."""
    values = as_numbers(read_text(path, _MATRIX).split())
    if values is None or len(values) != 16:
        raise InputError(f"{path}: is not {_MATRIX}; export it again or remove it")
    return values.reshape(4, 4)


def _scannet_camera(path: Path, image: Path) -> Camera | None:
    if not path.is_file():
        return None
    matrix = _read_matrix(path)
    size = stored_size(image)
    return pinhole(size, (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]), path)


def _replica_camera(source: Path) -> Camera | None:
    for path in (source / "cam_params.json", source.resolve().parent / "cam_params.json"):
        if path.is_file():
            lens = read_object(path, "the camera").get("camera")
            keys = ("w", "h", "fx", "fy", "cx", "cy")
            values = [lens.get(key) for key in keys] if isinstance(lens, dict) else None
            w, h, fx, fy, cx, cy = array_of(values, (6,), "camera: w h fx fy cx cy", path).tolist()
            return pinhole((w, h), (fx, fy), (cx, cy), path)
    return None
