"""Scene points from ``reconstruction.nvm``, the VisualSFM model (NVM_V3) that Cambridge Landmarks scenes ship with.

Cameras are lines ``name focal qw qx qy qz cx cy cz radial 0``: the quaternion is world-to-camera, the centre in the
world. Points are lines ``X Y Z R G B n`` and n times ``image feature x y``. Each block follows a line with its count;
more models may follow the first, which alone is read. The focal length is in pixels of the full image, the principal
point at its centre; the radial distortion is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from mambaloc.data.frames import Frames
from mambaloc.data.points.reconstructions import Reconstruction, plain_name, points_of_frames, rows_by_name
from mambaloc.data.points.scene_points import ScenePoints
from mambaloc.errors import InputError
from mambaloc.geometry import canonical, conjugate

NVM_FILE = "reconstruction.nvm"
_LONGEST_LINE = 1 << 22  # characters; a track through 100,000 images is shorter
_POINT_NUMBERS, _TRACK_NUMBERS = 7, 4


def read_nvm_points(folder: Path, frames: Frames, count: int, seed: int) -> ScenePoints:
    """Draw, of each frame, points whose track lists its image; the arguments of ``read_depth_points``.

    Raises:
        InputError: for a file that is malformed, holds none of the frames, or holds them in other poses.
    """
    path = folder / NVM_FILE
    size = _image_size(frames.image_paths[0])
    with path.open(encoding="utf-8", errors="replace") as file:
        model = _read_model(_Lines(path, file), rows_by_name(folder, frames), size)
    return points_of_frames(model, path, frames, count, seed, size, "nvm")


class _Lines:
    """The lines of a file that is not trusted, and where it is in them."""

    def __init__(self, path: Path, file: TextIO) -> None:
        self.path, self.file, self.number = path, file, 0

    def next(self) -> str:
        """The next line that is not blank; empty at the end of the file."""
        while line := self.file.readline(_LONGEST_LINE):
            self.number += 1
            if len(line) == _LONGEST_LINE:
                raise self.error("is too long")
            if line.strip():
                return line.strip()
        return ""

    def counted(self, what: str) -> Iterator[str]:
        """As many lines as the next line says; they are only looked for, so a count that lies costs nothing."""
        announced = self.next()
        try:
            count = int(announced)
        except ValueError:
            count = -1
        if count < 0:
            raise self.error(f"is not the number of {what}")
        for read in range(count):
            line = self.next()
            if not line:
                raise InputError(f"{self.path}: ends after {read} of {count} {what}; it is cut off, get it again")
            yield line

    def error(self, rule: str) -> InputError:
        return InputError(f"{self.path}, line {self.number}: {rule}; it is damaged, get it again or remove it")


def _read_model(lines: _Lines, rows: dict[str, int], size: tuple[int, int]) -> Reconstruction:
    if not lines.next().startswith("NVM_V3"):
        raise lines.error("does not begin with NVM_V3")
    names: list[str] = []
    cameras: list[list[float]] = []
    for line in lines.counted("cameras"):
        name, numbers = _read_camera(lines, line)
        names.append(plain_name(name))
        cameras.append(numbers)
    known = {camera: rows[name] for camera, name in enumerate(names) if name in rows}
    seen: dict[int, list[tuple[float, float, float]]] = {camera: [] for camera in known}
    for line in track(lines.counted("points"), f"Reading {lines.path.name}", total=None, transient=True):
        point, images = _read_point(lines, line, len(cameras))
        for image in images:
            if image in seen:
                seen[image].append(point)
    if len(lines.next().split()) > _POINT_NUMBERS:
        raise lines.error("follows the last of the points that were announced")
    table = np.array([cameras[camera] for camera in known]).reshape(-1, 8)
    quaternion = canonical(conjugate(torch.from_numpy(table[:, 1:5]))).numpy()
    points = [np.array(of).reshape(-1, 3) for of in seen.values()]
    return Reconstruction(
        np.array([*known.values()], int), table[:, 5:], quaternion, _pinhole(table[:, 0], size), points
    )


def _read_camera(lines: _Lines, line: str) -> tuple[str, list[float]]:
    """A camera's name and ``focal qw qx qy qz cx cy cz``."""
    name, *words = line.rsplit(maxsplit=10)
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 10 or not np.isfinite(numbers).all():
        raise lines.error("is not a camera 'name focal qw qx qy qz cx cy cz radial 0'")
    if numbers[0] <= 0 or float(np.linalg.norm(numbers[1:5])) < 0.5:
        raise lines.error("is a camera with a focal length of 0 or less, or a quaternion near zero")
    return name, numbers[:8]


def _read_point(lines: _Lines, line: str, cameras: int) -> tuple[tuple[float, float, float], list[int]]:
    """A point's position in metres and the images of its track."""
    words = line.split()
    try:
        x, y, z = map(float, words[:3])
        images = [int(word) for word in words[_POINT_NUMBERS::_TRACK_NUMBERS]]
        length = int(words[_POINT_NUMBERS - 1])
    except (ValueError, IndexError):
        raise lines.error("is not a point 'X Y Z R G B n' with n times 'image feature x y'") from None
    if length != len(images) or len(words) != _POINT_NUMBERS + _TRACK_NUMBERS * length:
        raise lines.error(f"is a point with a track of {length}, but has {len(words) - _POINT_NUMBERS} numbers of it")
    if images and not (min(images) >= 0 and max(images) < cameras):
        raise lines.error(f"is a point seen by an image that is none of the {cameras} cameras")
    if not np.isfinite((x, y, z)).all():
        raise lines.error("is a point whose position is not finite")
    return (x, y, z), images


def _pinhole(focal_px: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """Intrinsics of focal lengths at the centre of images of a size (width, height); (M,) -> (M, 3, 3)."""
    centre = np.array([[0, 0, (size[0] - 1) / 2], [0, 0, (size[1] - 1) / 2], [0, 0, 1]])
    return centre + focal_px[:, None, None] * np.diag([1.0, 1.0, 0.0])


def _image_size(path: Path) -> tuple[int, int]:
    """Width and height of the first frame, which the cache has decoded and holds all others to."""
    image = cv2.imread(str(path))
    if image is None:
        raise InputError(f"{path}: image cannot be decoded; mend or remove it")
    return image.shape[1], image.shape[0]
