"""Import a capture that captures_written.py wrote, and count the frames that are read, and read wrongly."""

from __future__ import annotations

import csv
import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
from captures_drawn import Drawn
from captures_written import draw
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.importing.importer import import_scene

WITHIN = 1e-6
_MAX_DIFFERENCE = 4.0  # of 255: what JPEG loses


def count_one(seed: int, folder: Path) -> tuple[str, Counter[str], str]:
    """Write, import and compare one capture: its kind, counts, and the refusal if there was one."""
    kind, drawn = draw(folder / "capture", seed)
    good = {path: pose for path, pose in drawn.truth.items() if pose is not None}
    counts = Counter(captures=1, should=len(good))
    try:
        import_scene(folder / "capture", folder / "scene")
    except InputError as error:
        return kind, counts + Counter(refused=1), str(error)
    except Exception as error:  # a user would see its traceback
        return kind, counts + Counter(refused=1, tracebacks=1), f"{type(error).__name__}: {error}"
    for image, pose in _written(folder / "scene"):
        path = _source_of(image, drawn)
        truth = None if path is None else drawn.truth[path]
        is_equal = truth is not None and np.abs(pose - truth).max() <= WITHIN
        counts += Counter(read=1, equal=int(is_equal), silent=int(not is_equal))
    return kind, counts, ""


def _written(scene: Path) -> list[tuple[Path, np.ndarray]]:
    """Each image of a scene and its pose in the source's world, read by the standard library and SciPy."""
    offset = json.loads((scene / "scene.json").read_text()).get("world", {}).get("offset_m", (0, 0, 0))
    found = []
    with (scene / "frames.csv").open(newline="") as lines:
        for row in csv.DictReader(lines):
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_quat([float(row[name]) for name in ("qx", "qy", "qz", "qw")]).as_matrix()
            pose[:3, 3] = np.array([float(row[name]) for name in "xyz"]) + offset
            found.append((scene / row["image"], pose))
    return found


def _source_of(image: Path, drawn: Drawn) -> Path | None:
    """The image that a written one was made of, by what it shows: names may have changed."""
    shown = np.array(cv2.imread(str(image), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION), int)
    same_shape = {path: stored for path, stored in drawn.pixels.items() if stored.shape == shown.shape}
    off = {path: float(np.abs(stored - shown).mean()) for path, stored in same_shape.items()}
    nearest = min(off, key=off.__getitem__, default=None)
    return nearest if nearest is not None and off[nearest] < _MAX_DIFFERENCE else None
