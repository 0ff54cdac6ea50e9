"""Seconds from the start of a process to given errors: of trainings, of a map, and of pycolmap's own route.

python tools/benchmarks/time_to_accuracy.py SWEEP.yaml [--reach M/DEG ...] [--out FOLDER]
    [--map MAP_RECIPE.yaml] [--frames N] [--width PX]

Whatever a process does before its first answer counts: Python's start, reading frames, views, features. Measuring
errors does not. One process runs at a time. Trainings are watched on the frames that the sweep validates on.
"""

from __future__ import annotations

import json
import time
from argparse import ArgumentTypeError, RawDescriptionHelpFormatter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from maps_beside import errors_of_pose
from maps_colmap import ColmapRoute, WrittenImages
from maps_scenes import key_and_query
from rich.console import Console
from rich.table import Table

from mambaloc import provenance
from mambaloc.benchmark.footprint import in_a_process
from mambaloc.benchmark.report import new_table
from mambaloc.console import OptionParser, configure_logging, exit_on_input_error, whole_number
from mambaloc.errors import InputError
from mambaloc.files import atomic_folder
from mambaloc.mapping.building import build_map
from mambaloc.mapping.evaluating import measure
from mambaloc.mapping.keyframes import farthest_first
from mambaloc.mapping.recipe import MapRecipe, read_recipe
from mambaloc.sweep import Trial, read_sweep
from mambaloc.sweep.running import run_folder, run_trial, train_command


@dataclass(frozen=True)
class Errors:
    """Median errors, sought or found."""

    position_m: float
    rotation_deg: float

    def __str__(self) -> str:
        return f"{self.position_m:g} m, {self.rotation_deg:g}°"


@dataclass(frozen=True)
class Way:
    """One way to a localizer.

    Args:
        name: of it.
        began_s: seconds from the process's start to the first step of a training; of a map, to the map.
        history: seconds from the process's start, and the errors found then.
    """

    name: str
    began_s: float
    history: tuple[tuple[float, Errors], ...]

    def seconds_to(self, sought: Errors) -> float | None:
        """Seconds to the first errors that are both no larger than those sought; None where there were none."""
        return next(
            (
                seconds
                for seconds, found in self.history
                if found.position_m <= sought.position_m and found.rotation_deg <= sought.rotation_deg
            ),
            None,
        )


REACH = (Errors(0.2, 6), Errors(0.19, 6.3), Errors(0.1, 3), Errors(0.05, 2))


@exit_on_input_error
def main() -> None:
    """Measure each way, print the table, and write every figure to ``time_to_accuracy.json``."""
    configure_logging()
    parser = OptionParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("sweep", type=Path, help="of trainings, as recipes/sweeps/ holds them")
    parser.add_argument("--map", type=Path, help="recipe of a map, to measure beside pycolmap's route")
    parser.add_argument("--frames", type=whole_number(2), help="key frames of the map; the recipe's unless given")
    parser.add_argument("--width", type=whole_number(32), help="of its images, in pixels; the recipe's unless given")
    parser.add_argument("--reach", type=errors_sought, nargs="+", default=REACH, metavar="M/DEG", help="errors sought")
    parser.add_argument("--out", type=Path, default=Path("runs/time_to_accuracy"), help="folder to write")
    args = parser.parse_args()
    sweep, recipe = read_sweep(args.sweep), read_recipe(args.map) if args.map else None
    given = {"key_frames": args.frames, "width": args.width}
    given = {key: value for key, value in given.items() if value is not None}
    if given and not recipe:
        raise InputError(f"--{'frames' if args.frames else 'width'}: is of a map. Give its recipe with --map.")
    if recipe:
        recipe = replace(recipe, settings=replace(recipe.settings, **given))
    with atomic_folder(args.out, "choose another folder with --out") as folder:
        ways = [measure_training(trial, folder, sweep.time_limit_s, sweep.cpus) for trial in sweep.trials]
        if recipe:
            ways += measure_maps(recipe)
        about = {"commit": provenance.commit(), "versions": provenance.versions(), "machine": provenance.machine()}
        result = about | {"ways": [asdict(way) for way in ways]}
        (folder / "time_to_accuracy.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    console = Console(highlight=False)
    console.print(table(ways, args.reach))
    console.print(f"Seconds from the start of each process; {about['machine']}; {args.out}", soft_wrap=True)


def errors_sought(text: str) -> Errors:
    """Read ``METRES/DEGREES``.

    Raises:
        ArgumentTypeError: for anything else.
    """
    try:
        position_m, rotation_deg = map(float, text.split("/"))
    except ValueError:
        raise ArgumentTypeError(f"{text}: is not METRES/DEGREES, such as 0.2/6") from None
    return Errors(position_m, rotation_deg)


def measure_training(trial: Trial, out: Path, time_limit_s: float, cpus: float) -> Way:
    """Train, and read when each validation had which errors.

    Raises:
        InputError: where the training fails, or nothing was validated.
    """
    started = time.time()
    outcome = run_trial(train_command(trial, out), run_folder(out, trial.key), time_limit_s, cpus)
    if outcome.error is not None:
        raise InputError(f"{trial.name}: {outcome.error}. Correct its recipe in the sweep.")
    return way_of_training(trial.name, started, outcome.results["last"]["training"]["wall_clock"])


def way_of_training(name: str, started: float, clock: dict[str, Any]) -> Way:
    """What a training's wall clock says, counted from the time of day at which its process was started.

    Raises:
        InputError: where nothing was validated.
    """
    if not clock["history"]:
        raise InputError(f"{name}: nothing was validated. Add recipes/overlays/watched.yaml to it.")
    began_s = clock["began_at"] - started
    history = (
        (began_s + each["train_s"], Errors(each["position_error_m"], each["rotation_error_deg"]))
        for each in clock["history"]
    )
    return Way(name, began_s, tuple(history))


def measure_maps(recipe: MapRecipe) -> list[Way]:
    """Build a recipe's map, then pycolmap's of the same key frames at the same size, and localize the test frames."""
    frames = f"{recipe.settings.key_frames} key frames"
    with TemporaryDirectory() as work:
        return [
            Way(f"map, {frames}", *in_a_process(_map, recipe, time.time())),
            Way(f"pycolmap, {frames}", *in_a_process(_colmap, recipe, Path(work), time.time())),
        ]


def _map(recipe: MapRecipe, started: float) -> tuple[float, tuple[tuple[float, Errors], ...]]:
    train, queries = key_and_query(recipe, None)
    sparse_map = build_map(train, recipe.settings, recipe.name)
    built_s = time.time() - started
    found = measure(sparse_map, queries, recipe.ransac_seeds[:1])
    return built_s, ((built_s, _medians(found.position_m, found.rotation_deg)),)


def _colmap(recipe: MapRecipe, work: Path, started: float) -> tuple[float, tuple[tuple[float, Errors], ...]]:
    train, queries = key_and_query(recipe, None)
    key = train.select(farthest_first(train.world_from_cam, recipe.settings.key_frames))
    route = ColmapRoute(WrittenImages.write(key, recipe.settings.width, work / "key"), work / "route")
    route.work.mkdir()
    route.build()
    built_s = time.time() - started
    shown = WrittenImages.write(queries, recipe.settings.width, work / "query")
    scores = [
        errors_of_pose(pose, truth) for pose, truth in zip(route.localize(shown), shown.world_from_cam, strict=True)
    ]
    return built_s, ((built_s, _medians(*np.transpose(scores))),)


def _medians(position_m: Any, rotation_deg: Any) -> Errors:
    return Errors(float(np.median(position_m)), float(np.median(rotation_deg)))


def table(ways: Sequence[Way], reach: Sequence[Errors]) -> Table:
    """Seconds of each way to each of the errors, and its last errors."""
    shown = new_table("Seconds to", "way", "first step, or map", *map(str, reach), "at the end")
    for way in ways:
        seconds = [way.seconds_to(sought) for sought in reach]
        cells = ["never" if each is None else f"{each:.0f}" for each in seconds]
        last_s, last = way.history[-1]
        end = f"{last_s:.0f}: {last.position_m:.3f} m, {last.rotation_deg:.2f}°"
        shown.add_row(way.name, f"{way.began_s:.0f}", *cells, end)
    return shown


if __name__ == "__main__":
    main()
