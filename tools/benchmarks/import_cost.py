"""What an import of many posed frames costs in this checkout and in others: seconds and memory, in turns.

python tools/benchmarks/import_cost.py [CHECKOUT ...] [--frames 10000] [--turns 3]
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mambaloc.console import OptionParser, exit_on_input_error, whole_number
from mambaloc.errors import InputError

_HERE = Path(__file__).parents[2]
_SIZE = (64, 48)
_SEQUENCES = 8  # of a scene of 7-Scenes; every fourth is for testing
_MIB_KIB = 1024
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

Cost = tuple[float, float, float]
"""Seconds computed, seconds passed, and the largest resident memory in MiB."""


@exit_on_input_error
def main() -> None:
    """Print the medians of each layout and checkout, and this checkout's share of each other's."""
    parser = OptionParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkouts", type=Path, nargs="*", metavar="CHECKOUT", help="others to compare with")
    parser.add_argument("--frames", type=whole_number(24), default=10_000)
    parser.add_argument("--turns", type=whole_number(1), default=3, help="of each checkout, one after another")
    args = parser.parse_args()
    with TemporaryDirectory() as work:
        for write in (write_nerfstudio, write_seven_scenes):
            source = Path(work, write.__name__.removeprefix("write_"))
            write(source, args.frames)
            print_costs(source.name, measure([_HERE, *args.checkouts], source, args.turns))


def measure(checkouts: list[Path], source: Path, turns: int) -> dict[Path, list[Cost]]:
    """Import a capture so many times with each checkout, in turns.

    Raises:
        InputError: where an import fails.
    """
    costs: dict[Path, list[Cost]] = {checkout: [] for checkout in checkouts}
    for _ in range(turns):
        for checkout in checkouts:
            with TemporaryDirectory(dir=source.parent) as out:
                costs[checkout].append(_import(checkout.resolve(), source, Path(out, "scene")))
    return costs


def print_costs(layout: str, costs: dict[Path, list[Cost]]) -> None:
    """Print a line a checkout: medians, and what the first took for each of its."""
    first, *_ = medians = [[median(values) for values in zip(*each, strict=True)] for each in costs.values()]
    for checkout, (cpu_s, wall_s, memory_mib) in zip(costs, medians, strict=True):
        shares = f"this one's share {first[0] / cpu_s:.2f}, {first[1] / wall_s:.2f}, {first[2] / memory_mib:.2f}"
        turns = ", ".join(f"{each[0]:.1f}" for each in costs[checkout])
        print(
            f"{layout:12} {checkout}: {cpu_s:.1f} s computed ({turns}), {wall_s:.1f} s passed, "
            f"{memory_mib:.0f} MiB; {shares}",
            flush=True,
        )


def _import(checkout: Path, source: Path, out: Path) -> Cost:
    command = [sys.executable, "tools/import_scene.py", str(source), "--out", str(out)]
    start = time.perf_counter()
    process = subprocess.Popen(
        command, cwd=checkout, env={**os.environ, "PYTHONPATH": str(checkout)}, stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise InputError(f"{checkout}: its import of {source.name} ended with code {process.returncode}. Repair it.")
    return usage.ru_utime + usage.ru_stime, time.perf_counter() - start, usage.ru_maxrss / _MIB_KIB


def write_nerfstudio(folder: Path, count: int) -> None:
    """Write a ``transforms.json`` with one camera."""
    width, height = _SIZE
    names = [f"images/frame_{row:06d}.jpg" for row in range(count)]
    poses = _write_images(folder, names) @ _OPENGL
    camera = {"w": width, "h": height, "fl_x": 0.9 * width, "fl_y": 0.9 * width, "cx": width / 2, "cy": height / 2}
    frames = [{"file_path": name, "transform_matrix": pose.tolist()} for name, pose in zip(names, poses, strict=True)]
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}), encoding="utf-8")


def write_seven_scenes(folder: Path, count: int) -> None:
    """Write sequences in the layout of 7-Scenes."""
    length = -(-count // _SEQUENCES)
    stems = [f"seq-{1 + row // length:02d}/frame-{row % length:06d}" for row in range(count)]
    for stem, pose in zip(stems, _write_images(folder, [f"{stem}.color.png" for stem in stems]), strict=True):
        np.savetxt(folder / f"{stem}.pose.txt", pose, fmt="%.9f")
    for name, rests in (("TrainSplit.txt", (1, 2, 3)), ("TestSplit.txt", (0,))):
        listed = [f"sequence{number}\n" for number in range(1, _SEQUENCES + 1) if number % 4 in rests]
        (folder / name).write_text("".join(listed), encoding="utf-8")


def _write_images(folder: Path, names: list[str]) -> NDArray[np.float64]:
    """Write an image of soft noise for each name; returns poses (N, 4, 4) of a walk in circles, camera-to-world."""
    rng, angle = np.random.default_rng(0), np.linspace(0, len(names) / 100, len(names))
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        coarse = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
        cv2.imwrite(str(path), cv2.resize(coarse, _SIZE, interpolation=cv2.INTER_CUBIC))
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    turns = np.stack((angle, 0.1 * np.sin(3 * angle), np.full_like(angle, 2.0)), axis=1)
    poses[:, :3, :3] = Rotation.from_euler("ZYX", turns).as_matrix()
    radius = 2 + 0.3 * np.sin(0.37 * angle)
    poses[:, :3, 3] = np.stack((radius * np.cos(angle), radius * np.sin(angle), 1.4 + 0.1 * np.sin(angle)), axis=1)
    return poses


if __name__ == "__main__":
    main()
