"""``reconstruction.nvm``, the VisualSFM model (NVM_V3) that Cambridge Landmarks scenes ship with.

Cameras are lines ``name focal qw qx qy qz cx cy cz radial 0``: the quaternion is world-to-camera, the centre in the
world. Points are lines ``X Y Z R G B n`` and n times ``image feature x y``. Each block follows a line with its count;
more models may follow the first, which alone is read. The focal length is in pixels of the full image, the principal
point at its centre; the radial distortion is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from mambaloc.data.frames import plain_name
from mambaloc.errors import InputError
from mambaloc.text import open_text

NVM_FILE = "reconstruction.nvm"
_LONGEST_LINE = 1 << 22  # characters; a track through 100,000 images is shorter
_POINT_NUMBERS, _TRACK_NUMBERS = 7, 4

Point = tuple[float, float, float]


@dataclass(frozen=True)
class NvmCameras:
    """The M cameras of a model.

    Shape:
        ``names`` (M,), images without suffix; ``focal_px`` (M,); ``cam_from_world`` (M, 4), quaternions wxyz as the
        file has them; ``centre_m`` (M, 3).
    """

    names: list[str]
    focal_px: NDArray[np.float64]
    cam_from_world: NDArray[np.float64]
    center_m: NDArray[np.float64]


def read_nvm_cameras(path: Path) -> NvmCameras:
    """Read the cameras of a model, without its points.

    Raises:
        InputError: for a file that is malformed as far as it is read.
    """
    with open_text(path) as file:
        return _read_cameras(_Lines(path, file))


def read_nvm(path: Path, wanted: set[str]) -> tuple[NvmCameras, dict[int, list[Point]]]:
    """Read a model: its cameras, and by its row the points of each camera whose name is wanted.

    Raises:
        InputError: for a malformed file.
    """
    with open_text(path) as file:
        lines = _Lines(path, file)
        cameras = _read_cameras(lines)
        seen: dict[int, list[Point]] = {row: [] for row, name in enumerate(cameras.names) if name in wanted}
        for line in track(lines.counted("points"), f"Reading {path.name}", total=None, transient=True):
            point, images = _read_point(lines, line, len(cameras.names))
            for image in images:
                if image in seen:
                    seen[image].append(point)
        if len(lines.next().split()) > _POINT_NUMBERS:
            raise lines.error("follows the last of the points that were announced")
    return cameras, seen


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
                raise InputError(f"{self.path}: ends after {read} of {count} {what}; it is truncated, get it again")
            yield line

    def error(self, rule: str) -> InputError:
        return InputError(f"{self.path}, line {self.number}: {rule}; it is damaged, get it again or remove it")


def _read_cameras(lines: _Lines) -> NvmCameras:
    if not lines.next().startswith("NVM_V3"):
        raise lines.error("does not begin with NVM_V3")
    cameras = [_read_camera(lines, line) for line in lines.counted("cameras")]
    table = np.array([numbers for _, numbers in cameras]).reshape(-1, 8)
    return NvmCameras([plain_name(name) for name, _ in cameras], table[:, 0], table[:, 1:5], table[:, 5:])


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


def _read_point(lines: _Lines, line: str, cameras: int) -> tuple[Point, list[int]]:
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
        raise lines.error(f"is a point seen by an image that is not one of the {cameras} cameras")
    if not np.isfinite((x, y, z)).all():
        raise lines.error("is a point whose position is not finite")
    return (x, y, z), images
