"""Imported scenes: anyone's capture as ``mambaloc import`` writes it.

``SCENE/frames.csv`` has a row a frame, in the order of :data:`COLUMNS`: an image's path in the folder, the camera's
``world_from_cam``, the split that it is in. ``SCENE/scene.json`` has cameras, units and what was decided.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mambaloc.data.datasets.dataset import Dataset
from mambaloc.data.frames import FARTHEST, UNIT_TOLERANCE, BadFrames, Frames, Split
from mambaloc.errors import InputError
from mambaloc.files import path_inside, read_json
from mambaloc.runtime.rotations import canonical
from mambaloc.runtime.world import World
from mambaloc.text import open_text

CAPTURE = "capture"
"""Name of the dataset whose scenes ``mambaloc import`` made, each named by its folder's path."""

SCENE_FILE, FRAMES_FILE = "scene.json", "frames.csv"
VERSION_KEY, VERSION = "mambaloc_scene", 1
WORLD_KEY = "world"
COLUMNS = ("image", "sequence", "time_s", "x", "y", "z", "qw", "qx", "qy", "qz", "camera", "split")
SPLITS = ("train", "val", "test", "unused")

MAX_FRAMES = 200_000
_MEND = "import the scene again"


@dataclass(frozen=True)
class Row:
    """A row of ``frames.csv``, checked; ``pose`` is x, y, z, qw, qx, qy, qz, ``time_s`` None where it has no time."""

    image: Path
    sequence: str
    pose: tuple[float, ...]
    camera: str
    split: str
    time_s: float | None = None


def scene_note(folder: Path) -> dict[str, Any]:
    """What a folder's ``scene.json`` says, whatever wrote it; empty if none can be read."""
    try:
        note = read_json(folder / SCENE_FILE, _MEND, _MEND)
    except InputError:
        return {}
    return note if isinstance(note, dict) else {}


def is_captured(folder: Path) -> bool:
    """Whether a folder is an imported scene, of whatever version."""
    return VERSION_KEY in scene_note(folder)


def read_split(folder: Path, split: Split, bad: BadFrames) -> Frames:
    """Read the posed frames of one split of a scene's folder; none, where it marks none for validation.

    Raises:
        InputError: for a malformed file, a scene that was found not usable, or a split without frames; and for a
            missing image where ``bad`` says so.
    """
    _usable(folder)
    rows = [row for row in read_rows(folder) if row.split == split]
    kept = []
    for row in rows:
        if row.image.is_file():
            kept.append(row)
        else:
            bad.reject(row.image, "pose without image")
    if not kept and split != "val":
        raise InputError(f"{folder / FRAMES_FILE}: has no usable frame of split {split}; {_MEND}, or mark some")
    poses = np.array([row.pose for row in kept], dtype=np.float64).reshape(-1, 7)
    return Frames(
        tuple(row.image for row in kept),
        tuple(row.sequence for row in kept),
        poses[:, :3].copy(),
        canonical(poses[:, 3:]),
    )


def read_scene(folder: Path) -> dict[str, Any]:
    """Read ``scene.json``.

    Raises:
        InputError: if it is not an imported scene, or of another version.
    """
    path = folder / SCENE_FILE
    scene = read_json(path, _MEND, _MEND)
    if not isinstance(scene, dict) or VERSION_KEY not in scene:
        raise InputError(f"{path}: is not of an imported scene; make one with mambaloc import")
    if scene[VERSION_KEY] != VERSION:
        raise InputError(f"{path}: has version {str(scene[VERSION_KEY])[:20]}, but {VERSION} is expected; {_MEND}")
    return scene


def read_rows(folder: Path) -> list[Row]:
    """Read ``frames.csv``.

    Raises:
        InputError: for an invalid row, with its line number.
    """
    path = folder / FRAMES_FILE
    rows: list[Row] = []
    lines: dict[Path, int] = {}
    for line, fields in _table(path):
        row = _row(folder, fields, f"{path}, line {line}")
        if row.image in lines:
            raise InputError(f"{path}, line {line}: {fields['image']} is on line {lines[row.image]}, too; remove one")
        lines[row.image] = line
        rows.append(row)
        if len(rows) > MAX_FRAMES:
            raise InputError(f"{path}: has more than {MAX_FRAMES} rows; keep fewer")
    if not rows:
        raise InputError(f"{path}: has no row; {_MEND}")
    return rows


def world_of(folder: Path) -> World:
    """Where an imported scene lies in the world of its source; no shift where a scene is older, or none was imported.

    Raises:
        InputError: where ``scene.json`` has none that can be read.
    """
    try:
        return World.from_json(scene_note(folder).get(WORLD_KEY))
    except ValueError as error:
        raise InputError(f"{folder / SCENE_FILE}: {error}; {_MEND}") from None


def describe_capture(folder: Path) -> dict[str, Any]:
    """What a result must state of an imported scene: its unit, its source, its world,
    how it was split."""
    scene = read_scene(folder)
    imported, split = (value if isinstance(value := scene.get(key), dict) else {} for key in ("imported", "split"))
    return {
        "unit": scene.get("unit"),
        "format": imported.get("format"),
        "split_by": split.get("chosen"),
        "world": asdict(world_of(folder)),
    }


def _usable(folder: Path) -> None:
    sanity = read_scene(folder).get("sanity")
    verdict = sanity.get("verdict") if isinstance(sanity, dict) else None
    if isinstance(verdict, str) and verdict.startswith("not usable"):
        raise InputError(f"{folder}: was found {verdict[:400]}; see report.md there, and {_MEND}")


def _table(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of a CSV file by column, each with its line."""
    try:
        with open_text(path, newline="", errors="strict") as file:
            table = csv.reader(file, strict=True)
            header = next(table, [])
            if tuple(header) != COLUMNS:
                raise InputError(f"{path}, line 1: is not {','.join(COLUMNS)}; {_MEND}")
            for words in table:
                if len(words) != len(COLUMNS):
                    raise InputError(
                        f"{path}, line {table.line_num}: has {len(words)} columns, not {len(COLUMNS)}; correct the row"
                    )
                yield table.line_num, dict(zip(COLUMNS, words, strict=True))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {_MEND}") from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"{path}: is not CSV ({error}); {_MEND}") from None


def _row(folder: Path, fields: dict[str, str], where: str) -> Row:
    image = path_inside(folder, fields["image"])
    if image is None:
        raise InputError(f"{where}: image {fields['image'][:80]!r} is not a path inside the folder; correct the row")
    if fields["split"] not in SPLITS:
        raise InputError(f"{where}: split {fields['split'][:20]!r} is not one of {', '.join(SPLITS)}; correct the row")
    if not fields["sequence"]:
        raise InputError(f"{where}: names no sequence; correct the row")
    numbers = ("x", "y", "z", "qw", "qx", "qy", "qz", *(["time_s"] if fields["time_s"] else []))
    try:
        values = {name: float(fields[name]) for name in numbers}
    except ValueError:
        raise InputError(f"{where}: {', '.join(numbers)} are not all numbers; correct the row") from None
    if not all(math.isfinite(value) for value in values.values()):
        raise InputError(f"{where}: has NaN or infinite numbers; correct the row")
    pose = tuple(values[name] for name in numbers[:7])
    if max(map(abs, pose[:3])) > FARTHEST:
        raise InputError(f"{where}: lies farther than {FARTHEST:g} from the origin; shift the world towards it")
    if abs(math.hypot(*pose[3:]) - 1) > UNIT_TOLERANCE:
        raise InputError(f"{where}: quaternion has length {math.hypot(*pose[3:]):.6g}, not 1; correct the row")
    return Row(image, fields["sequence"], pose, fields["camera"], fields["split"], values.get("time_s"))


DATASET = Dataset(CAPTURE, read_split, {}, Path("scenes"), marks_validation=True)
