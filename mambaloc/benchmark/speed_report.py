"""All of speed in one run: measured, as tables in the terminal with ratios first, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from rich.console import Console
from rich.table import Table

from mambaloc import provenance
from mambaloc.benchmark.footprint import Footprint, exponent, measure_footprints, measure_scaling
from mambaloc.benchmark.report import new_table
from mambaloc.benchmark.speed import (
    LOOP_ALONE,
    OURS,
    PARTS,
    REFERENCE,
    Setting,
    Speed,
    check_speed,
    measure_speed,
    ratio,
)
from mambaloc.benchmark.whole_training import WholeTraining, check_whole_training, measure_whole_training
from mambaloc.errors import InputError
from mambaloc.files import whole_file, writing


@dataclass(frozen=True)
class SpeedReport:
    """What one run measured; see the classes of its parts.

    Args:
        setting: what was trained on what.
        speed: images a second, parts of a step.
        footprints: memory and seconds to the first step.
        scaling: the same for whole epochs, by frames.
        whole: a training to its end, if an error was sought.
    """

    setting: Setting
    speed: Speed
    footprints: list[Footprint]
    scaling: list[Footprint]
    whole: WholeTraining | None = None


def measure_all(
    setting: Setting,
    batches: Sequence[int] = (16, 32),
    frames: Sequence[int] = (),
    steps: int = 4,
    repetitions: int = 5,
    workers: int = 2,
    sought_m: float | None = None,
) -> SpeedReport:
    """Measure everything, one thing after another.

    Args:
        setting: what is trained on what.
        batches: images a step to try, beside the setting's own.
        frames: of the trainings whose epochs are timed whole.
        steps: of a repetition.
        repetitions: timed, after one that warms up.
        workers: loader processes of the reference.
        sought_m: median position error to train a process from its start for, if any.

    Raises:
        InputError: for too few repetitions to tell a spread, or a scene with too few frames.
    """
    _check(setting, frames, sought_m)
    check_speed(setting.build()[1], batches, steps, repetitions)
    footprints = measure_footprints(setting, steps, workers)
    speed = measure_speed(setting, batches, steps, repetitions, workers)
    scaling = measure_scaling(setting, frames)
    whole = None if sought_m is None else measure_whole_training(setting, sought_m)
    return SpeedReport(setting, speed, footprints, scaling, whole)


def _check(setting: Setting, frames: Sequence[int], sought_m: float | None) -> None:
    """Tell what is wrong before anything is measured.

    Raises:
        InputError: for numbers that cannot be measured on this scene.
    """
    if len(frames) == 1:
        raise InputError(f"--frames {frames[0]}: how cost grows takes two numbers or more")
    if sought_m is not None:
        check_whole_training(setting)
    data = setting.build()[1]
    data.setup("fit")
    if max(frames, default=0) > len(data.frames("train")):
        raise InputError(f"--frames {max(frames)}: the scene has {len(data.frames('train'))} to train on")


def print_report(report: SpeedReport, machine: str) -> None:
    """Print every part that was measured."""
    console = Console(highlight=False)
    print_speed(report.speed, console)
    print_footprints(report.footprints, console)
    if report.scaling:
        print_scaling(report.scaling, console)
    if report.whole:
        print_whole_training(report.whole, console)
    console.print(f"{report.setting.system}, medians; {machine}", soft_wrap=True)


def write_report(report: SpeedReport, path: Path, machine: str) -> None:
    """Write every figure, and where it comes from, as JSON."""
    told = {"machine": machine, "versions": provenance.versions(), **asdict(report)}
    with writing(path), whole_file(path) as partial:
        partial.write_text(json.dumps(told, indent=1, default=str), encoding="utf-8")


def print_speed(speed: Speed, console: Console) -> None:
    """Print training and evaluation beside the reference, then where a step's time goes."""
    table = new_table("Images a second", "what", "ratio", "± IQR", "ours", "reference")
    _rates(table, "training", speed.training[OURS], speed.training[REFERENCE])
    if LOOP_ALONE in speed.training:
        _rates(table, "training, our network in it", speed.training[OURS], speed.training[LOOP_ALONE])
    _rates(table, "evaluation, the reference one at a time", speed.evaluation[OURS], speed.evaluation[REFERENCE])
    console.print(table)
    best = max(speed.batches, key=lambda size: median(speed.batches[size]))
    rates = ", ".join(f"{size}: {median(found):.1f}" for size, found in speed.batches.items())
    console.print(f"images/s by images a step: {rates}; best {best}", soft_wrap=True)
    seconds = 1000 / median(speed.training[OURS]), 1000 / median(speed.training[REFERENCE])
    console.print(f"1000 frames in steps of {speed.batch}: {seconds[0]:.1f} s, the reference {seconds[1]:.1f} s")
    console.print(_parts(speed))


def _rates(table: Table, what: str, ours: Sequence[float], theirs: Sequence[float]) -> None:
    times, spread = ratio(ours, theirs)
    table.add_row(what, f"{times:.2f}", f"{spread:.2f}", f"{median(ours):.1f}", f"{median(theirs):.1f}")


def _parts(speed: Speed) -> Table:
    table = new_table(f"Milliseconds of a step of {speed.batch} images", "part", "ours", "share", "reference", "share")
    medians = {way: {part: median(taken) for part, taken in of_each.items()} for way, of_each in speed.parts.items()}
    totals = {way: sum(of_each.values()) for way, of_each in medians.items()}
    for part in PARTS:
        cells = []
        for way in (OURS, REFERENCE):
            seconds = medians[way].get(part)
            cells += ["", ""] if seconds is None else [f"{1000 * seconds:.2f}", f"{seconds / totals[way]:.1%}"]
        table.add_row("Lightning's trainer" if part == "trainer" else part, *cells)
    table.add_row("all", *(cell for way in (OURS, REFERENCE) for cell in (f"{1000 * totals[way]:.2f}", "")))
    return table


def print_footprints(footprints: Sequence[Footprint], console: Console) -> None:
    """Print memory and seconds to the first step, ours and the reference's, each in a process of its own."""
    table = new_table("A process of its own", "way", "to the first step s", "host MiB", "device MiB")
    for each in footprints:
        memory = (f"{size / 2**20:.0f}" for size in (each.host_bytes, each.device_bytes))
        table.add_row(each.way, f"{each.first_step_s:.1f}", *memory)
    console.print(table)


def print_scaling(footprints: Sequence[Footprint], console: Console) -> None:
    """Print seconds an epoch and memory by frames, with the exponents that fit them."""
    table = new_table(
        "By frames, each in a process of its own", "frames", "epoch s", "ms a frame", "host MiB", "device MiB"
    )
    for each in footprints:
        memory = (f"{size / 2**20:.0f}" for size in (each.host_bytes, each.device_bytes))
        table.add_row(str(each.frames), f"{each.epoch_s:.2f}", f"{1000 * each.epoch_s / each.frames:.2f}", *memory)
    console.print(table)
    frames = [each.frames for each in footprints]
    fits = (exponent(frames, costs) for costs in ([e.epoch_s for e in footprints], [e.host_bytes for e in footprints]))
    console.print("seconds grow as frames to the {:.2f}, host memory to the {:.2f}".format(*fits))


def print_whole_training(whole: WholeTraining, console: Console) -> None:
    """Print seconds from the start of a process to its error and its end."""
    reached = "was not reached" if whole.reached_s is None else f"after {whole.reached_s:.1f} s"
    frames = "THE TEST SET" if whole.selection == "test_set" else f"validation frames ({whole.selection})"
    console.print(
        f"a process that trains on {whole.frames} frames, validation not counted: first step after "
        f"{whole.first_step_s:.1f} s; {whole.sought_m} m on {frames} {reached}; {whole.steps} steps after "
        f"{whole.ended_s:.1f} s, with {whole.position_error_m:.3f} m, {whole.rotation_error_deg:.2f} deg",
        soft_wrap=True,
    )
