"""Captures in formats that the importer reads, written by NumPy and SciPy alone, with what is true of them.

What is drawn with each: names and their order, clocks and their units, the encoding of texts, an origin as in UTM,
frames without a fix, orientation tags, sizes of pictures. A pose means the pixels that a file stores.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

GRID_M = (441547.25, 5121947.5, 346.125)
PER_S = {"s": Decimal(1), "ms": Decimal(10) ** 3, "us": Decimal(10) ** 6, "ns": Decimal(10) ** 9}
GL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass
class Drawn:
    """What was drawn of a capture, before it is written in a format.

    Args:
        folder: to write to.
        rng: for more draws.
        poses: true ``world_from_cam``, (N, 4, 4).
        marks: what a frame has instead of its pose: ``nan``, ``zeros`` or ``origin``; None of most.
        sizes: (width, height) of each picture.
        encoding: of texts.
        newline: of texts.
        truth: the true pose by the path of its picture, once written; None of frames without a fix.
        pixels: of each picture, as it is stored.
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

    def picture(self, row: int, name: str) -> None:
        """Write a frame's picture, perhaps with an orientation tag, and keep what is true of it."""
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
        return _line([*position, *(xyzw if order == "xyzw" else [xyzw[3], *xyzw[:3]])])

    def names(self) -> list[str]:
        """Stems of pictures in order of time, of one kind: padded, unpadded, or with words around."""
        style = str(self.rng.choice(["{:06d}", "{}", "frame_{}", "IMG {:03d}", "frame-{:06d}.color"]))
        first = int(self.rng.integers(0, 96))
        return [style.format(first + row) for row in range(len(self.poses))]


def _line(numbers: list[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _tagged(jpeg: bytes, orientation: int) -> bytes:
    """A JPEG with an EXIF orientation, 1 to 8, after its first marker."""
    entry = (0x0112).to_bytes(2, "little") + b"\x03\x00\x01\x00\x00\x00" + orientation.to_bytes(4, "little")
    exif = b"Exif\x00\x00II*\x00\x08\x00\x00\x00\x01\x00" + entry + b"\x00\x00\x00\x00"
    return jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]


def clock(drawn: Drawn) -> tuple[list[str], list[str]]:
    """Stems of pictures and words of poses: one recording's times, each in a unit of its own."""
    start = Decimal(1403636579) if drawn.rng.random() < 0.8 else Decimal(5)
    units = list(PER_S) if start > 1000 else ["s"]
    step = Decimal(int(drawn.rng.integers(30, 150))) / 1000
    times = [start + row * step + Decimal(763555555) / 10**9 for row in range(len(drawn.poses))]
    late = Decimal(int(drawn.rng.integers(0, 4))) / 1000
    of_pictures, of_poses = (str(drawn.rng.choice(units)) for _ in range(2))
    stems = [f"{t * PER_S[of_pictures]:.9f}" if of_pictures == "s" else f"{t * PER_S[of_pictures]:.0f}" for t in times]
    digits = 9 if of_poses == "s" else int(drawn.rng.choice([0, 6]))
    return stems, [f"{(t + late) * PER_S[of_poses]:.{digits}f}" for t in times]


def tum(drawn: Drawn) -> None:
    """A trajectory by time beside pictures that are named by theirs."""
    stems, words = clock(drawn)
    lines = [f"{word} {drawn.words(row)}" for row, word in enumerate(words)]
    drawn.text(str(drawn.rng.choice(["trajectory.txt", "poses_est.txt", "run.tum"])), "\n".join(lines) + "\n")
    for row, stem in enumerate(stems):
        drawn.picture(row, f"rgb/{stem}.png")


def tum_rgbd(drawn: Drawn) -> None:
    """The layout of TUM's benchmark."""
    stems, words = clock(drawn)
    drawn.text("rgb.txt", "# images\n" + "".join(f"{stem} rgb/{stem}.png\n" for stem in stems))
    lines = [f"{word} {drawn.words(row)}" for row, word in enumerate(words)]
    drawn.text("groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines))
    for row, stem in enumerate(stems):
        drawn.picture(row, f"rgb/{stem}.png")


def table_by_time(drawn: Drawn) -> None:
    """A table without names of pictures."""
    stems, words = clock(drawn)
    rows = [[word, *drawn.words(row, "wxyz").split()] for row, word in enumerate(words)]
    _table(drawn, ["timestamp", "x", "y", "z", "qw", "qx", "qy", "qz"], rows)
    for row, stem in enumerate(stems):
        drawn.picture(row, f"images/{stem}.jpg")


def table(drawn: Drawn) -> None:
    """A table of names, in any order of rows."""
    names = [f"{stem}.jpg" for stem in drawn.names()]
    rows = [[f"images/{name}", *drawn.words(row, "wxyz").split()] for row, name in enumerate(names)]
    for row, mark in enumerate(drawn.marks):
        rows[row] = [rows[row][0], *[""] * 7] if mark == "nan" else rows[row]
    shuffled = [rows[at] for at in drawn.rng.permutation(len(rows))]
    _table(drawn, ["image", "x", "y", "z", "qw", "qx", "qy", "qz"], shuffled)
    for row, name in enumerate(names):
        drawn.picture(row, f"images/{name}")


def _table(drawn: Drawn, header: list[str], rows: list[list[str]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, delimiter=str(drawn.rng.choice([",", ";", "\t"])), lineterminator="\n")
    writer.writerows([header, *rows])
    drawn.text("poses.csv", text.getvalue())


def in_order(drawn: Drawn) -> None:
    """Twelve or sixteen numbers a line, row by row or column by column."""
    rows, by_column = int(drawn.rng.choice([3, 4])), drawn.rng.random() < 0.3
    matrices = [drawn.matrix(row)[:rows] for row in range(len(drawn.poses))]
    lines = [_line((matrix.T if by_column else matrix).ravel().tolist()) for matrix in matrices]
    drawn.text(str(drawn.rng.choice(["poses.txt", "traj.log", "cam2world.txt"])), "\n".join(lines) + "\n")
    for row, stem in enumerate(drawn.names()):
        drawn.picture(row, f"images/{stem}.jpg")


def named(drawn: Drawn) -> None:
    """A name and a matrix a line, or a name and ``qw qx qy qz tx ty tz`` of the world in the camera."""
    inverse = drawn.rng.random() < 0.6
    lines = []
    for row, stem in enumerate(drawn.names()):
        drawn.picture(row, f"seq1/{stem}.jpg")
        numbers = drawn.matrix(row).ravel().tolist()
        if inverse and drawn.marks[row] is None:
            turn, cam_from_world = Rotation.from_matrix(drawn.poses[row, :3, :3]), np.linalg.inv(drawn.poses[row])
            numbers = [*np.roll(turn.inv().as_quat(), 1).tolist(), *cam_from_world[:3, 3].tolist()]
        elif inverse:
            position, xyzw = drawn.seven(row)
            numbers = [xyzw[3], *xyzw[:3], *position]
        lines.append(f"seq1/{stem}.jpg {_line(numbers)}")
    drawn.text("poses.txt", "\n".join(lines) + "\n")


def beside(drawn: Drawn) -> None:
    """A file of its own for each pose."""
    style = str(drawn.rng.choice(["7scenes", "X.txt", "X.npy", "folders", "scannet"]))
    for row, stem in enumerate(drawn.names()):
        matrix, stem = drawn.matrix(row), stem.removesuffix(".color")
        text = "\n".join(_line(line) for line in matrix.tolist())
        if style == "X.npy":
            drawn.picture(row, f"seq-01/{stem}.jpg")
            np.save(drawn.folder / f"seq-01/{stem}.npy", matrix)
            continue
        picture, pose = {
            "7scenes": (f"seq-01/frame-{row:06d}.color.jpg", f"seq-01/frame-{row:06d}.pose.txt"),
            "X.txt": (f"{stem}.jpg", f"{stem}.txt"),
            "folders": (f"train/rgb/{stem}.jpg", f"train/poses/{stem}.txt"),
            "scannet": (f"color/{row}.jpg", f"pose/{row}.txt"),
        }[style]
        drawn.picture(row, picture)
        drawn.text(pose, text)


def nerfstudio(drawn: Drawn) -> None:
    """``transforms.json``, frames in any order."""
    frames = []
    for row, stem in enumerate(drawn.names()):
        drawn.picture(row, f"images/{stem}.jpg")
        matrix = drawn.matrix(row, GL)
        matrix[3] = (0, 0, 0, 1)
        frames.append({"file_path": f"images/{stem}.jpg", "transform_matrix": matrix.tolist()})
    shuffled = [frames[at] for at in drawn.rng.permutation(len(frames))]
    drawn.text("transforms.json", json.dumps({"frames": shuffled}))


KINDS: tuple[Callable[[Drawn], None], ...] = (
    tum, tum_rgbd, table_by_time, table, in_order, named, beside, nerfstudio,
)  # fmt: skip


def draw(folder: Path, seed: int) -> tuple[str, Drawn]:
    """Write a capture, and return its kind and what is true."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(6, 15))
    angle = np.linspace(0, 2, count) + rng.normal(0, 0.02, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.stack((angle, 0.1 * np.sin(angle), 2 + 0 * angle), 1)).as_matrix()
    poses[:, :3, 3] = np.stack((9 + 2 * np.cos(angle), 6 + 2 * np.sin(angle), 1.4 + 0.1 * angle), 1)
    poses[:, :3, 3] += GRID_M if rng.random() < 0.4 else (0, 0, 0)
    marks: list[str | None] = [None] * count
    for row in rng.choice(count, int(rng.choice([0, 0, 1, 2])), replace=False).tolist():
        marks[row] = str(rng.choice(["nan", "zeros", "origin"]))
    sizes = [(64, 48) if rng.random() < 0.7 else (32, 24) for _ in range(count)]
    sizes = sizes if rng.random() < 0.3 else [(64, 48)] * count
    encoding = str(rng.choice(["utf-8", "utf-8", "utf-8-sig", "utf-16"]))
    drawn = Drawn(folder, rng, poses, marks, sizes, encoding, str(rng.choice(["\n", "\r\n"])))
    write = KINDS[seed % len(KINDS)]
    write(drawn)
    return write.__name__, drawn
