"""Captures in formats that the importer reads, written by NumPy and SciPy alone, with their ground truth.

What is drawn with each: names and their order, clocks and their units, the encoding of texts, an origin as in UTM,
frames without a fix, orientation tags, sizes of images. A pose means the pixels that a file stores.
"""

from __future__ import annotations

import csv
import io
import json
import struct
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import numpy as np
from captures_drawn import Drawn, line
from scipy.spatial.transform import Rotation

GRID_M = (441547.25, 5121947.5, 346.125)
PER_S = {"s": Decimal(1), "ms": Decimal(10) ** 3, "us": Decimal(10) ** 6, "ns": Decimal(10) ** 9}
GL = np.diag([1.0, -1.0, -1.0, 1.0])


def clock(drawn: Drawn) -> tuple[list[str], list[str]]:
    """Stems of images and words of poses: one recording's times, each in a unit of its own."""
    start = Decimal(1403636579) if drawn.rng.random() < 0.8 else Decimal(5)
    units = list(PER_S) if start > 1000 else ["s"]
    step = Decimal(int(drawn.rng.integers(30, 150))) / 1000
    times = [start + row * step + Decimal(763555555) / 10**9 for row in range(len(drawn.poses))]
    late = Decimal(int(drawn.rng.integers(0, 4))) / 1000
    image_unit, pose_unit = (str(drawn.rng.choice(units)) for _ in range(2))
    stems = [f"{t * PER_S[image_unit]:.9f}" if image_unit == "s" else f"{t * PER_S[image_unit]:.0f}" for t in times]
    digits = 9 if pose_unit == "s" else int(drawn.rng.choice([0, 6]))
    return stems, [f"{(t + late) * PER_S[pose_unit]:.{digits}f}" for t in times]


def tum(drawn: Drawn) -> None:
    """A trajectory by time beside images that are named by theirs."""
    stems, words = clock(drawn)
    lines = [f"{word} {drawn.words(row)}" for row, word in enumerate(words)]
    drawn.text(str(drawn.rng.choice(["trajectory.txt", "poses_est.txt", "run.tum"])), "\n".join(lines) + "\n")
    for row, stem in enumerate(stems):
        drawn.image(row, f"rgb/{stem}.png")


def tum_rgbd(drawn: Drawn) -> None:
    """The layout of TUM's benchmark."""
    stems, words = clock(drawn)
    drawn.text("rgb.txt", "# images\n" + "".join(f"{stem} rgb/{stem}.png\n" for stem in stems))
    lines = [f"{word} {drawn.words(row)}" for row, word in enumerate(words)]
    drawn.text("groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines))
    for row, stem in enumerate(stems):
        drawn.image(row, f"rgb/{stem}.png")


def table_by_time(drawn: Drawn) -> None:
    """A table without names of images."""
    stems, words = clock(drawn)
    rows = [[word, *drawn.words(row, "wxyz").split()] for row, word in enumerate(words)]
    _table(drawn, ["timestamp", "x", "y", "z", "qw", "qx", "qy", "qz"], rows)
    for row, stem in enumerate(stems):
        drawn.image(row, f"images/{stem}.jpg")


def table(drawn: Drawn) -> None:
    """A table of names, in any order of rows."""
    names = [f"{stem}.jpg" for stem in drawn.names()]
    rows = [[f"images/{name}", *drawn.words(row, "wxyz").split()] for row, name in enumerate(names)]
    for row, mark in enumerate(drawn.marks):
        rows[row] = [rows[row][0], *[""] * 7] if mark == "nan" else rows[row]
    shuffled = [rows[at] for at in drawn.rng.permutation(len(rows))]
    _table(drawn, ["image", "x", "y", "z", "qw", "qx", "qy", "qz"], shuffled)
    for row, name in enumerate(names):
        drawn.image(row, f"images/{name}")


def _table(drawn: Drawn, header: list[str], rows: list[list[str]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, delimiter=str(drawn.rng.choice([",", ";", "\t"])), lineterminator="\n")
    writer.writerows([header, *rows])
    drawn.text("poses.csv", text.getvalue())


def in_order(drawn: Drawn) -> None:
    """Twelve or sixteen numbers a line, row by row or column by column."""
    rows, by_column = int(drawn.rng.choice([3, 4])), drawn.rng.random() < 0.3
    matrices = [drawn.matrix(row)[:rows] for row in range(len(drawn.poses))]
    lines = [line((matrix.T if by_column else matrix).ravel().tolist()) for matrix in matrices]
    drawn.text(str(drawn.rng.choice(["poses.txt", "traj.log", "cam2world.txt"])), "\n".join(lines) + "\n")
    for row, stem in enumerate(drawn.names()):
        drawn.image(row, f"images/{stem}.jpg")


def named(drawn: Drawn) -> None:
    """A name and a matrix a line, or a name and ``qw qx qy qz tx ty tz`` of the world in the camera."""
    inverse = drawn.rng.random() < 0.6
    lines = []
    for row, stem in enumerate(drawn.names()):
        drawn.image(row, f"seq1/{stem}.jpg")
        numbers = drawn.matrix(row).ravel().tolist()
        if inverse and drawn.marks[row] is None:
            turn, cam_from_world = Rotation.from_matrix(drawn.poses[row, :3, :3]), np.linalg.inv(drawn.poses[row])
            numbers = [*np.roll(turn.inv().as_quat(), 1).tolist(), *cam_from_world[:3, 3].tolist()]
        elif inverse:
            position, xyzw = drawn.seven(row)
            numbers = [xyzw[3], *xyzw[:3], *position]
        lines.append(f"seq1/{stem}.jpg {line(numbers)}")
    drawn.text("poses.txt", "\n".join(lines) + "\n")


def beside(drawn: Drawn) -> None:
    """A file of its own for each pose."""
    style = str(drawn.rng.choice(["7scenes", "X.txt", "X.npy", "folders", "scannet"]))
    for row, stem in enumerate(drawn.names()):
        matrix, stem = drawn.matrix(row), stem.removesuffix(".color")
        text = "\n".join(line(numbers) for numbers in matrix.tolist())
        if style == "X.npy":
            drawn.image(row, f"seq-01/{stem}.jpg")
            np.save(drawn.folder / f"seq-01/{stem}.npy", matrix)
            continue
        image_name, pose = {
            "7scenes": (f"seq-01/frame-{row:06d}.color.jpg", f"seq-01/frame-{row:06d}.pose.txt"),
            "X.txt": (f"{stem}.jpg", f"{stem}.txt"),
            "folders": (f"train/rgb/{stem}.jpg", f"train/poses/{stem}.txt"),
            "scannet": (f"color/{row}.jpg", f"pose/{row}.txt"),
        }[style]
        drawn.image(row, image_name)
        drawn.text(pose, text)


def nerfstudio(drawn: Drawn) -> None:
    """``transforms.json``, frames in any order."""
    frames = []
    for row, stem in enumerate(drawn.names()):
        drawn.image(row, f"images/{stem}.jpg")
        matrix = drawn.matrix(row, GL)
        matrix[3] = (0, 0, 0, 1)
        frames.append({"file_path": f"images/{stem}.jpg", "transform_matrix": matrix.tolist()})
    shuffled = [frames[at] for at in drawn.rng.permutation(len(frames))]
    drawn.text("transforms.json", json.dumps({"frames": shuffled}))


def colmap(drawn: Drawn) -> None:
    """A model as a text or in binary, a camera a size; COLMAP marks no frames without a fix, it leaves them out."""
    drawn.marks = [None] * len(drawn.poses)
    stems, sizes = drawn.names(), sorted(set(drawn.sizes))
    images = []
    for row, stem in enumerate(stems):
        drawn.image(row, f"images/{stem}.jpg")
        cam_from_world = np.linalg.inv(drawn.poses[row])
        turn = np.roll(Rotation.from_matrix(cam_from_world[:3, :3]).as_quat(), 1)
        numbers = [*turn.tolist(), *cam_from_world[:3, 3].tolist()]
        images.append((row + 1, numbers, 1 + sizes.index(drawn.sizes[row]), f"{stem}.jpg"))
    cameras = [(number, *size, *_lens(size)) for number, size in enumerate(sizes, start=1)]
    model = drawn.folder / str(drawn.rng.choice(["sparse", "sparse/0"]))
    if drawn.rng.random() < 0.5:
        name = model.relative_to(drawn.folder).as_posix()
        camera_lines = [f"{number} PINHOLE {w} {h} {line(list(lens))}" for number, w, h, *lens in cameras]
        drawn.text(f"{name}/cameras.txt", "\n".join(camera_lines) + "\n")
        lines = [f"{number} {line(numbers)} {camera} {file}\n\n" for number, numbers, camera, file in images]
        drawn.text(f"{name}/images.txt", "# Image list\n" + "".join(lines))
        drawn.text(f"{name}/points3D.txt", "")
        return
    model.mkdir(parents=True)
    count = struct.Struct("<Q").pack
    camera_records = [struct.pack("<IiQQ4d", number, 1, w, h, *lens) for number, w, h, *lens in cameras]
    (model / "cameras.bin").write_bytes(count(len(cameras)) + b"".join(camera_records))
    records = [
        struct.pack("<I7dI", number, *numbers, camera) + file.encode() + b"\0" + count(0)
        for number, numbers, camera, file in images
    ]
    (model / "images.bin").write_bytes(count(len(images)) + b"".join(records))
    (model / "points3D.bin").write_bytes(count(0))


def polycam(drawn: Drawn) -> None:
    """Polycam's raw data; optimised cameras beside those of ARKit, which are 10 cm off, or the latter alone."""
    drawn.marks = [None] * len(drawn.poses)
    prefix, start = str(drawn.rng.choice(["corrected_", ""])), int(drawn.rng.integers(10**8, 10**9))
    for row in range(len(drawn.poses)):
        stamp = start + 250_000 * row
        drawn.image(row, f"keyframes/{prefix}images/{stamp}.jpg")
        width, height = drawn.sizes[row]
        fx, fy, cx, cy = _lens((width, height))
        camera = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height}
        for name, off_m in {"cameras": 0.1 if prefix else 0.0, f"{prefix}cameras": 0.0}.items():
            matrix = drawn.matrix(row, GL)
            shifted = {f"t_{i}{j}": matrix[i, j] + off_m * (j == 3) for i in range(3) for j in range(4)}
            drawn.text(f"keyframes/{name}/{stamp}.json", json.dumps({**camera, **shifted}))


def record3d(drawn: Drawn) -> None:
    """A recording of Record3D, of one size or with smaller images."""
    rows = []
    for row in range(len(drawn.poses)):
        drawn.image(row, f"rgbd/{row}.jpg")
        position, xyzw = drawn.seven(row)
        if drawn.marks[row] is None:
            xyzw = Rotation.from_matrix((drawn.poses[row] @ GL)[:3, :3]).as_quat().tolist()
        rows.append([*xyzw, *position])
    width, height = max(drawn.sizes)
    fx, fy, cx, cy = _lens((width, height))
    metadata = {"poses": rows, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1], "w": width, "h": height}
    drawn.text("metadata", json.dumps(metadata))


def _lens(size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Focal lengths and principal point of images of a size, from their corner."""
    return 0.9 * size[0], 0.9 * size[0], size[0] / 2, size[1] / 2


KINDS: tuple[Callable[[Drawn], None], ...] = (
    tum, tum_rgbd, table_by_time, table, in_order, named, beside, nerfstudio, colmap, polycam, record3d,
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
