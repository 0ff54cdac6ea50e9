"""Depth frames: ``frame-NNNNNN.depth.png`` beside the images, as 7-Scenes lays them out. Needs no torch.

A depth frame holds ``uint16`` millimetres along the optical axis; 0 and 65535 are pixels without a measurement. Its
camera is ``SCENE/camera-intrinsics.txt`` (3x3, pixels of the depth frames) or, without such a file, the official depth
sensor, whose view is narrower than the colour camera's: 585 px where that has 525.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.text import decode_text

INTRINSICS_FILE = "camera-intrinsics.txt"
_OFFICIAL_INTRINSICS = np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]])
_OFFICIAL_SIZE = (640, 480)
NO_DEPTH_MM = (0, 65535)
"""What a depth frame has at pixels without a measurement."""
_PNG_END = b"IEND\xaeB`\x82"  # OpenCV fills the missing part of a truncated file with zeros and says nothing


def depth_path(image: Path) -> Path:
    """Where the depth frame of an image is, if it has one."""
    return image.with_name(f"{image.name.partition('.')[0]}.depth.png")


def read_complete_png(path: Path) -> NDArray[Any] | None:
    """The numbers of a PNG as they are stored; None where the file cannot be read or is truncated."""
    try:
        data = path.read_bytes()
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data.endswith(_PNG_END) else None
    except (OSError, cv2.error):
        return None


def read_depth_mm(path: Path) -> NDArray[np.uint16]:
    """Read a depth frame, (H, W).

    Raises:
        InputError: where it is not a complete 16-bit PNG of one channel.
    """
    depth_mm = read_complete_png(path)
    if depth_mm is None or depth_mm.dtype != np.uint16 or depth_mm.ndim != 2:
        raise InputError(f"{path}: is not a complete 16-bit PNG of one channel. Repair or remove it.")
    return depth_mm


def read_depth_intrinsics(folder: Path, size: tuple[int, int]) -> NDArray[np.float64]:
    """The camera of depth frames of a size (width, height), (3, 3).

    Raises:
        InputError: where the folder's file of it does not hold a pinhole matrix.
    """
    path = folder / INTRINSICS_FILE
    if not path.is_file():
        matrix, scale = _OFFICIAL_INTRINSICS.copy(), np.divide(size, _OFFICIAL_SIZE)
        matrix[:2] *= scale[:, None]
        matrix[:2, 2] += (scale - 1) / 2  # pixel centres lie half a pixel inside of the border
        return matrix
    try:
        lines = decode_text(path.read_bytes()).splitlines()
        matrix = np.array([line.split() for line in lines if line.strip()], dtype=float)
    except (ValueError, OSError):
        matrix = np.empty(0)
    is_pinhole = matrix.shape == (3, 3) and np.isfinite(matrix).all() and np.allclose(matrix[2], (0, 0, 1))
    if not is_pinhole or min(matrix[0, 0], matrix[1, 1]) <= 0 or matrix[1, 0] != 0:
        raise InputError(f"{path}: is not a pinhole matrix 'fx 0 cx, 0 fy cy, 0 0 1' in pixels; correct or remove it")
    return matrix
