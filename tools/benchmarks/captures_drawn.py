"""What is drawn of a capture before it is written in a format, and how its texts and images are written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass
class Drawn:
    """What was drawn of a capture, before it is written in a format.

    Args:
        folder: to write to.
        rng: for more draws.
        poses: true ``world_from_cam``, (N, 4, 4).
        marks: what a frame has instead of its pose: ``nan``, ``zeros`` or ``origin``; None of most.
        sizes: (width, height) of each image.
        encoding: of texts.
        newline: of texts.
        truth: the true pose by the path of its image, once written; None of frames without a fix.
        pixels: of each image, as it is stored.
    """

    folder: Path
    rng: np.random.Generator
    poses: np.ndarray
    marks: list[str | None]
    sizes: list[tuple[int, int]]
    encoding: str
    newline: str
    truth: dict[Path, np.ndarray | None] = field(default_factory=dict)
    pixels: dict[Path, np.ndarray] = field(default_factory=dict)

    def text(self, name: str, content: str) -> None:
        """Write a text."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.replace("\n", self.newline).encode(self.encoding))

    def image(self, row: int, name: str) -> None:
        """Write a frame's image, perhaps with an orientation tag, and keep what is true of it."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        width, height = self.sizes[row]
        coarse = self.rng.integers(0, 256, (3, 4, 3), dtype=np.uint8)
        stored = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        options = [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else []
        data = cv2.imencode(path.suffix, stored, options)[1].tobytes()
        if path.suffix == ".jpg" and self.rng.random() < 0.3:
            data = _tagged(data, int(self.rng.integers(2, 9)))
        path.write_bytes(data)
        self.truth[path] = None if self.marks[row] else self.poses[row]
        self.pixels[path] = stored

    def matrix(self, row: int, axes: np.ndarray | None = None) -> np.ndarray:
        """A frame's matrix as a file has it, with its mark."""
        mark = self.marks[row]
        if mark == "origin":
            return np.eye(4)
        if mark is not None:
            return np.full((4, 4), np.nan if mark == "nan" else 0.0)
        return self.poses[row] if axes is None else self.poses[row] @ axes

    def seven(self, row: int) -> tuple[list[float], list[float]]:
        """A frame's position and quaternion xyzw, with its mark."""
        mark = self.marks[row]
        if mark is not None:
            number = np.nan if mark == "nan" else 0.0
            return [number] * 3, [0.0, 0.0, 0.0, 1.0] if mark == "origin" else [number] * 4
        turn = Rotation.from_matrix(self.poses[row, :3, :3]).as_quat()
        return self.poses[row, :3, 3].tolist(), turn.tolist()

    def words(self, row: int, order: str = "xyzw") -> str:
        """The seven numbers of a frame."""
        position, xyzw = self.seven(row)
        return line([*position, *(xyzw if order == "xyzw" else [xyzw[3], *xyzw[:3]])])

    def names(self) -> list[str]:
        """Stems of images in order of time, of one kind: padded, unpadded, or with words around."""
        style = str(self.rng.choice(["{:06d}", "{}", "frame_{}", "IMG {:03d}", "frame-{:06d}.color"]))
        first = int(self.rng.integers(0, 96))
        return [style.format(first + row) for row in range(len(self.poses))]


def line(numbers: list[float]) -> str:
    """Numbers as exactly as they are known."""
    return " ".join(repr(float(number)) for number in numbers)


def _tagged(jpeg: bytes, orientation: int) -> bytes:
    """A JPEG with an EXIF orientation, 1 to 8, after its first marker."""
    entry = (0x0112).to_bytes(2, "little") + b"\x03\x00\x01\x00\x00\x00" + orientation.to_bytes(4, "little")
    exif = b"Exif\x00\x00II*\x00\x08\x00\x00\x00\x01\x00" + entry + b"\x00\x00\x00\x00"
    return jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
