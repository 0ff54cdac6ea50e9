"""Import captures of mixed kinds whose truth is known, and count what is read, refused, and read wrongly.

python tools/benchmarks/captures.py [--count 500] [--seed 0]

Each is written by captures_written.py, which shares no code with the importer, and its scene is read back here by the
standard library and SciPy.
"""

from __future__ import annotations

import csv
import json
import tempfile
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
from captures_written import Drawn, draw
from scipy.spatial.transform import Rotation

from mambaloc.console import OptionParser, exits_cleanly
from mambaloc.errors import InputError
from mambaloc.importing.importer import import_scene

COUNTED = ("captures", "refused", "tracebacks", "should", "read", "equal", "silent")
"""Captures, and frames: that should be read, that were, with their true pose, and with another or none."""
WITHIN = 1e-6
_ALIKE = 4.0  # of 255: what JPEG loses


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
    for picture, pose in _written(folder / "scene"):
        path = _source_of(picture, drawn)
        truth = None if path is None else drawn.truth[path]
        is_equal = truth is not None and np.abs(pose - truth).max() <= WITHIN
        counts += Counter(read=1, equal=int(is_equal), silent=int(not is_equal))
    return kind, counts, ""


def _written(scene: Path) -> list[tuple[Path, np.ndarray]]:
    """Each picture of a scene and its pose in the source's world, read by the standard library and SciPy."""
    offset = json.loads((scene / "scene.json").read_text()).get("world", {}).get("offset_m", (0, 0, 0))
    found = []
    with (scene / "frames.csv").open(newline="") as lines:
        for row in csv.DictReader(lines):
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_quat([float(row[name]) for name in ("qx", "qy", "qz", "qw")]).as_matrix()
            pose[:3, 3] = np.array([float(row[name]) for name in "xyz"]) + offset
            found.append((scene / row["image"], pose))
    return found


def _source_of(picture: Path, drawn: Drawn) -> Path | None:
    """The picture that a written one was made of, by what it shows: names may have changed."""
    shown = np.array(cv2.imread(str(picture), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION), int)
    alike = {path: stored for path, stored in drawn.pixels.items() if stored.shape == shown.shape}
    off = {path: float(np.abs(stored - shown).mean()) for path, stored in alike.items()}
    nearest = min(off, key=off.__getitem__, default=None)
    return nearest if nearest is not None and off[nearest] < _ALIKE else None


@exits_cleanly
def main() -> None:
    """Print counts by kind and in all, and what was refused."""
    parser = OptionParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500, help="captures")
    parser.add_argument("--seed", type=int, default=0, help="of the first")
    args = parser.parse_args()
    by_kind: dict[str, Counter[str]] = {}
    for seed in range(args.seed, args.seed + args.count):
        with tempfile.TemporaryDirectory() as folder:
            kind, counts, said = count_one(seed, Path(folder))
        by_kind[kind] = by_kind.get(kind, Counter()) + counts
        if said or counts["silent"] or counts["equal"] < counts["should"]:
            print(f"seed {seed}, {kind}: {dict(counts)} {said.replace(folder, '')}", flush=True)
    print(f"{'kind':16}", *(f"{name:>10}" for name in COUNTED))
    for kind, counts in [*by_kind.items(), ("all", sum(by_kind.values(), Counter()))]:
        print(f"{kind:16}", *(f"{counts[name]:10}" for name in COUNTED))


if __name__ == "__main__":
    main()
