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
from mambaloc.benchmark.floors import Floors, measure_floors
from mambaloc.benchmark.footprint import Footprint, exponent, measure_footprints, measure_scaling
from mambaloc.benchmark.loading import LoadingRates, measure_loading
from mambaloc.benchmark.report import new_table
from mambaloc.benchmark.savings import SAVINGS, Savings, measure_savings
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
from mambaloc.models.registry import model_class
from mambaloc.models.transposenet import LitTransPoseNet


@dataclass(frozen=True)
class SpeedReport:
    """What one run measured; see the classes of its parts.

    Args:
        setting: what was trained on what.
        speed: images a second, parts of a step.
        loading: from the cache, and decoding.
        savings: of the network; None for a system without a published form here.
        floors: of a step.
        footprints: memory and seconds to the first step.
        scaling: the same for whole epochs, by frames.
        whole: a training to its end, if an error was sought.
    """

    setting: Setting
    speed: Speed
    loading: LoadingRates
    savings: Savings | None
    floors: Floors
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
    batch = setting.data.get("batch_size", 8)
    _check(setting, frames, sought_m)
    check_speed(setting.build()[1], batches, steps, repetitions)
    footprints = measure_footprints(setting, steps, workers)
    speed = measure_speed(setting, batches, steps, repetitions, workers)
    published = issubclass(model_class(setting.system), LitTransPoseNet)
    savings = measure_savings(setting, batch, repetitions) if published else None
    floors = measure_floors(setting, batch, repetitions)
    loading = measure_loading(setting.build()[1], repetitions=repetitions)
    scaling = measure_scaling(setting, frames)
    whole = None if sought_m is None else measure_whole_training(setting, sought_m)
    return SpeedReport(setting, speed, loading, savings, floors, footprints, scaling, whole)


def _check(setting: Setting, frames: Sequence[int], sought_m: float | None) -> None:
    """Tell what is wrong before anything is measured.

    Raises:
        InputError: for numbers that cannot be measured on this scene.
    """
    if len(frames) == 1:
        raise InputError(f"--frames {frames[0]}: how cost grows takes two numbers or more")
    if sought_m is not None:
        check_whole_training(setting)
    setting.is_half  # noqa: B018  it tells a precision that is not measured
    data = setting.build()[1]
    data.setup("fit")
    if max(frames, default=0) > len(data.frames("train")):
        raise InputError(f"--frames {max(frames)}: the scene has {len(data.frames('train'))} to train on")


def print_report(report: SpeedReport, machine: str) -> None:
    """Print every part that was measured."""
    console = Console(highlight=False)
    print_speed(report.speed, report.loading, console)
    if report.savings:
        print_savings(report.savings, console)
    print_floors(report.floors, console)
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


def print_speed(speed: Speed, loading: LoadingRates, console: Console) -> None:
    """Print loading, training and evaluation beside the reference, then where a step's time goes."""
    table = new_table("Images a second", "what", "ratio", "± IQR", "ours", "reference")
    _rates(table, "loading, a core", loading.cached, loading.decoded)
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


def print_savings(savings: Savings, console: Console) -> None:
    """Print what a forward and backward pass takes with each saving left out, and GIS's own part of it."""
    table = new_table("Forward and backward pass, times ours", "left out", "times ours", "± IQR")
    for name, seconds in savings.left_out.items():
        table.add_row(SAVINGS[name], *(f"{value:.3f}" for value in savings.times_as_long(seconds)))
    table.add_row("all of them: as published", *(f"{v:.3f}" for v in savings.times_as_long(savings.published)))
    console.print(table)
    if savings.gis and savings.gis_together:
        share, spread = savings.times_as_long(savings.gis)
        console.print(f"both branches' GIS: {share:.2%} ± {spread:.2%} of the pass")
        times, spread = ratio(savings.gis_together, savings.gis)
        console.print(f"the two as one block, weights stacked: {times:.2f} ± {spread:.2f} times as long as apart")


def print_floors(floors: Floors, console: Console) -> None:
    """Print how far a step is from the machine's rates, and its largest kernels."""
    rates = f"{floors.flops_per_s / 1e12:.3f} TFLOP/s, {floors.bytes_per_s / 1e9:.1f} GB/s"
    work = f"{floors.flops / 1e9:.1f} GFLOP, {floors.bytes / 1e9:.2f} GB"
    console.print(
        f"a step on a batch that is there: {1000 * floors.step_s:.2f} ms; {work}; this machine: {rates}\n"
        f"of the rate of operations it reaches {floors.of_operations:.0%}, of the bandwidth {floors.of_bytes:.0%}",
        soft_wrap=True,
    )
    table = new_table("Kernels of a step, by their own time", "kernel", "share")
    for name, share in floors.kernels:
        table.add_row(name if len(name) < 60 else f"{name[:57]}...", f"{share:.1%}")
    console.print(table)


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
