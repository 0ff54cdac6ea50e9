"""Measure what scenes cost before the first step: reading labels, decoding once, opening again, memory and disk.

python tools/benchmarks/scenes.py FOLDER [SCENE ...] [--dataset NAME] [--short-side PIXELS]
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.progress import track

from mambaloc import provenance
from mambaloc.benchmark.footprint import in_a_process, peak_bytes
from mambaloc.benchmark.report import new_table
from mambaloc.console import OptionParser, configure_logging, exit_on_input_error, whole_number
from mambaloc.data import PoseDataModule
from mambaloc.data.datasets.registry import DATASETS, scene_folder
from mambaloc.data.frames import BadFrames, Split
from mambaloc.errors import InputError
from mambaloc.user_cache import default_cache_dir


@dataclass(frozen=True)
class SceneCost:
    """A scene loaded whole, both splits, in a process of its own.

    Args:
        scene: its name.
        listed: frames that its split files list, by split.
        official: those of the benchmark of that name, train and test; None without a benchmark.
        rendered: whether our renderer made it.
        skipped: bad frames.
        read_s: reading splits and poses.
        build_s: decoding every image once, into a cache that was not there.
        open_s: the whole again, from that cache: what every later run waits for.
        peak_bytes: largest resident memory of the process, mapped pages of the cache included.
        start_bytes: its memory before the scene.
        image_bytes: of the image files.
        cache_bytes: of the cache.
    """

    scene: str
    listed: dict[str, int]
    official: tuple[int, int] | None
    rendered: bool
    skipped: int
    read_s: float
    build_s: float
    open_s: float
    peak_bytes: int
    start_bytes: int
    image_bytes: int
    cache_bytes: int

    @property
    def counts(self) -> tuple[int, int]:
        """Frames of both splits."""
        return self.listed["train"], self.listed["test"]


@exit_on_input_error
def main() -> None:
    """Measure scenes and print."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    parser.add_argument("root", type=Path, help="folder that holds them")
    parser.add_argument("scenes", nargs="*", help="names; every official one that is there unless given")
    parser.add_argument("--dataset", default="7scenes")
    parser.add_argument("--short-side", type=whole_number(1), default=256, help="what images are resized to, in pixels")
    args = parser.parse_args()
    print_scenes(measure_scenes(args.dataset, args.root, args.scenes, args.short_side), provenance.machine())


def measure_scenes(dataset: str, root: Path, scenes: Sequence[str], short_side: int = 256) -> list[SceneCost]:
    """Load scenes, one after another, each into a cache that is removed afterwards.

    Args:
        dataset: ``7scenes`` or ``cambridge``.
        root: folder that holds the scenes.
        scenes: their names; every official one that is there, if none is named.
        short_side: what images are resized to, in pixels.

    Raises:
        InputError: where a scene is not there, or none is.
    """
    if dataset not in DATASETS:
        raise InputError(f"unknown --dataset {dataset}; choose one of {', '.join(DATASETS)}")
    names = list(scenes) or [name for name in DATASETS[dataset].official_counts if (root / name).is_dir()]
    if not names:
        raise InputError(f"{root}: contains none of {', '.join(DATASETS[dataset].official_counts)}; name the scenes")
    kept = default_cache_dir()  # where the disk is that caches are for
    kept.mkdir(parents=True, exist_ok=True)
    found = []
    for name in track(names, "Loading scenes", console=Console(stderr=True), transient=True):
        with TemporaryDirectory(dir=kept) as cache:
            found.append(in_a_process(_measure, dataset, root, name, short_side, cache))
    return found


def print_scenes(scenes: Sequence[SceneCost], machine: str) -> None:
    """Print a row a scene: frames, seconds, memory, disk; then which are the benchmark's, and which are rendered."""
    names = ("scene", "frames", "read s", "decode s", "open s", "memory MiB", "disk MiB")
    table = new_table("Scenes loaded whole: train + test frames, images + cache on disk", *names)
    for each in scenes:
        train, test = each.counts
        seconds = (f"{s:.1f}" for s in (each.read_s, each.build_s, each.open_s))
        memory = f"{(each.peak_bytes - each.start_bytes) / 2**20:.0f}"
        disk = f"{each.image_bytes / 2**20:.0f} + {each.cache_bytes / 2**20:.0f}"
        table.add_row(each.scene, f"{train} + {test}", *seconds, memory, disk)
    console = Console(highlight=False)
    console.print(table)
    for label, which in {
        "of the benchmark's size": [each.scene for each in scenes if each.counts == each.official],
        "of another size than the benchmark's": [each.scene for each in scenes if each.counts != each.official],
        "rendered, no real images": [each.scene for each in scenes if each.rendered],
        "with bad frames": [f"{each.scene} ({each.skipped})" for each in scenes if each.skipped],
    }.items():
        if which:
            console.print(f"{label}: {', '.join(which)}", soft_wrap=True)
    console.print("decode: once, ever; open: from the cache, each run. Memory: the most while loading, the")
    console.print("cache's mapped pages included, less that of the process before it.")
    console.print(machine, soft_wrap=True)


def _measure(dataset: str, root: Path, scene: str, short_side: int, cache: str) -> SceneCost:
    def load() -> tuple[PoseDataModule, float]:
        start = time.perf_counter()
        data = PoseDataModule(
            dataset, str(root), scene, short_side=short_side, image_size=short_side, validation="none",
            on_bad_frame="skip", cache_dir=cache,
        )  # fmt: skip
        data.setup("fit")
        data.setup("test")
        return data, time.perf_counter() - start

    start_bytes = peak_bytes()
    start = time.perf_counter()
    folder = scene_folder(dataset, root, scene)
    splits: tuple[Split, ...] = ("train", "test")
    for split in splits:
        DATASETS[dataset].read_split(folder, split, BadFrames("skip"))
    read_s = time.perf_counter() - start
    _, build_s = load()
    data, open_s = load()
    description = data.describe()
    return SceneCost(
        scene,
        description["listed_frames"],
        DATASETS[dataset].official_counts.get(scene),
        description["rendered"],
        sum(sum(counts.values()) for counts in description["skipped"].values()),
        read_s,
        build_s - read_s,
        open_s,
        peak_bytes(),
        start_bytes,
        sum(path.stat().st_size for part in ("train", "test") for path in data.frames(part).image_paths),
        sum(path.stat().st_size for path in Path(cache).rglob("*") if path.is_file()),
    )


if __name__ == "__main__":
    main()
