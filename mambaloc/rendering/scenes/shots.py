"""The list of images to take: from sequences of poses, or from a table of a dataset's true poses."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mambaloc.errors import InputError
from mambaloc.rendering.quads import Vectors
from mambaloc.runtime.rotations import matrix_from_quaternion
from mambaloc.text import open_text

Layout = Literal["7scenes", "cambridge"]
FRAME_7SCENES = "seq-{sequence:02d}/frame-{frame:06d}.color.png"
FRAME_CAMBRIDGE = "seq{sequence}/frame{frame:05d}.png"

_COLUMNS = ("scene", "split", "image", "x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True, eq=False)
class Frame:
    """One image to take: its file, relative to the scene's folder, its split, and the camera's pose.

    Shape:
        ``world_from_cam`` (4, 4), metres.
    """

    image: str
    split: str
    world_from_cam: Vectors


def frames_of_sequences(
    sequences: Mapping[int, Vectors], test: Collection[int], image: str = FRAME_7SCENES
) -> list[Frame]:
    """The shots of whole sequences, in order.

    Args:
        sequences: ``world_from_cam`` (N, 4, 4) by sequence number.
        test: the sequences of the test split; all others train.
        image: a frame's file name, with the fields ``sequence`` and ``frame``.
    """
    return [
        Frame(image.format(sequence=number, frame=frame), "test" if number in test else "train", world_from_cam)
        for number, poses in sequences.items()
        for frame, world_from_cam in enumerate(poses)
    ]


def read_pose_table(path: Path, scene: str, layout: Layout) -> list[Frame]:
    """The shots of one scene of a table ``scene,split,image,x,y,z,qw,qx,qy,qz``, file names kept.

    The position is the camera centre in metres. The quaternion is what the dataset's own labels hold:
    camera-to-world for 7-Scenes, world-to-camera for Cambridge; it is normalised.

    Raises:
        InputError: for a missing column, a row that is not a pose, or a scene that is not in the table.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a CSV with the columns {','.join(_COLUMNS)}")
    scenes: set[str] = set()
    shots = []
    with open_text(path, newline="") as file:
        rows = csv.DictReader(file)
        if missing := [name for name in _COLUMNS if name not in (rows.fieldnames or ())]:
            raise InputError(f"{path}, line 1: columns {', '.join(missing)} are missing; name them in the first line")
        try:
            for row in rows:
                scenes.add(row["scene"])
                if row["scene"] == scene:
                    shots.append(_shot(row, layout, f"{path}, line {rows.line_num}"))
        except csv.Error as error:  # a field without end
            raise InputError(f"{path}, line {rows.line_num}: is not a CSV row ({error}); correct it") from None
    if not shots:
        raise InputError(f"{path}: has no row of scene {scene!r}; choose one of {', '.join(sorted(map(str, scenes)))}")
    return shots


def parse_size(text: str) -> tuple[int, int]:
    """Read ``320x240`` as width and height in pixels.

    Raises:
        InputError: for anything else.
    """
    match = re.fullmatch(r"([1-9]\d{1,3})x([1-9]\d{1,3})", text)
    if not match:
        raise InputError(f"size {text!r}: must be WIDTHxHEIGHT in pixels, 10 to 9999 each; give one such as 320x240")
    return int(match[1]), int(match[2])


def thinned(shots: Iterable[Frame], limit: int) -> list[Frame]:
    """At most ``limit`` shots of each split, evenly spaced.

    Raises:
        InputError: for a limit below 1.
    """
    if limit < 1:
        raise InputError(f"limit {limit}: a split keeps at least one frame; give 1 or more")
    by_split: dict[str, list[Frame]] = {}
    for shot in shots:
        by_split.setdefault(shot.split, []).append(shot)
    return [
        part[k]
        for part in by_split.values()
        for k in np.unique(np.linspace(0, len(part) - 1, min(limit, len(part))).round().astype(int))
    ]


def _shot(row: Mapping[str, str], layout: Layout, where: str) -> Frame:
    try:
        numbers = np.array([float(row[name]) for name in _COLUMNS[3:]])
    except (TypeError, ValueError):
        raise InputError(f"{where}: x,y,z,qw,qx,qy,qz must be seven numbers; correct or remove the row") from None
    if not np.isfinite(numbers).all() or np.linalg.norm(numbers[3:]) < 1e-3:
        raise InputError(f"{where}: a pose must be finite and its quaternion not zero; correct or remove the row")
    if row["split"] not in ("train", "test"):
        raise InputError(f"{where}: split {row['split']!r} is neither train nor test; correct the row")
    image = (row["image"] or "").removeprefix(f"{row['scene']}/")
    if not image.endswith((".png", ".jpg")) or image.startswith("/") or ".." in Path(image).parts:
        raise InputError(f"{where}: image {image!r} must be a .png or .jpg inside the scene; correct the row")
    rotation = matrix_from_quaternion(numbers[3:])
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = rotation if layout == "7scenes" else rotation.T
    world_from_cam[:3, 3] = numbers[:3]
    return Frame(image, row["split"], world_from_cam)
