"""All of speed in one run: measured, as tables in the terminal, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from rich.console import Console
from rich.table import Table

from mambaloc import provenance
from mambaloc.benchmark.clock import PARTS
from mambaloc.benchmark.footprint import Footprint, exponent, measure_scaling
from mambaloc.benchmark.report import new_table
from mambaloc.benchmark.setting import BenchmarkConfig
from mambaloc.benchmark.speed import OURS, Program, measure_speed, times_as_long
from mambaloc.benchmark.whole_training import WholeTraining, check_whole_training, measure_whole_training
from mambaloc.errors import InputError
from mambaloc.files import atomic_file, writing


@dataclass(frozen=True)
class SpeedReport:
    """What one run measured; see the classes of its parts.

    Args:
        setting: what was trained on what.
        programs: steps, ours and the published.
        scaling: whole epochs, by frames.
        whole: a training to its end, if an error was sought.
    """

    setting: BenchmarkConfig
    programs: list[Program]
    scaling: list[Footprint]
    whole: WholeTraining | None = None


def measure_all(
    setting: BenchmarkConfig,
    batches: Sequence[int] = (),
    frames: Sequence[int] = (),
    steps: int = 3,
    turns: int = 3,
    sought_m: float | None = None,
) -> SpeedReport:
    """Measure everything, one thing after another.

    Args:
        setting: what is trained on what.
        batches: images a step; the setting's own unless given.
        frames: of the trainings whose epochs are timed whole.
        steps: of a turn, after one that warms up.
        turns: of each program.
        sought_m: median position error to train a process from its start for, if any.

    Raises:
        InputError: for what cannot be measured on this scene.
    """
    _check(setting, frames, sought_m)
    programs = measure_speed(setting, batches, steps, turns)
    scaling = measure_scaling(setting, frames)
    whole = None if sought_m is None else measure_whole_training(setting, sought_m)
    return SpeedReport(setting, programs, scaling, whole)


def _check(setting: BenchmarkConfig, frames: Sequence[int], sought_m: float | None) -> None:
    """Check the arguments before anything is measured.

    Raises:
        InputError: for numbers that cannot be measured on this scene.
    """
    if len(frames) == 1:
        raise InputError(f"--frames {frames[0]}: needs at least two values to fit a scaling exponent")
    if sought_m is not None:
        check_whole_training(setting)
    data = setting.build()[1]
    data.setup("fit")
    if max(frames, default=0) > len(data.frames("train")):
        raise InputError(f"--frames {max(frames)}: the scene has {len(data.frames('train'))} to train on")


def print_report(report: SpeedReport, machine: str) -> None:
    """Print every part that was measured."""
    console = Console(highlight=False)
    print_programs(report, console)
    if report.scaling:
        print_scaling(report.scaling, console)
    if report.whole:
        print_whole_training(report.whole, console)
    console.print(f"{report.setting.system}; {machine}", soft_wrap=True)


def write_report(report: SpeedReport, path: Path, machine: str) -> None:
    """Write every figure, and where it comes from, as JSON."""
    content = {"machine": machine, "versions": provenance.versions(), **asdict(report)}
    with writing(path), atomic_file(path) as partial:
        partial.write_text(json.dumps(content, indent=1, default=str), encoding="utf-8")


def print_programs(report: SpeedReport, console: Console) -> None:
    """Print seconds and memory of a step beside the published program's, then its parts, by batch and dropout."""
    on_gpu = report.setting.device.type == "cuda"
    for ours in (program for program in report.programs if program.name == OURS):
        beside = [program for program in report.programs if program.is_beside(ours)]
        dropout = "" if ours.attention_dropout is None else f", attention dropout {ours.attention_dropout:g}"
        console.print(_steps(f"A step of {ours.batch} images{dropout}", ours, beside, on_gpu))
        console.print(_parts([program for program in beside if program.keeps_memory]))
    seconds = "seconds" if on_gpu else "CPU seconds of the process"
    memory = "by tensors on the GPU" if on_gpu else "of the process, libraries included"
    console.print(
        f"Medians of {len(report.programs[0].turns)} turns, lowest and highest in brackets, each turn in a process of "
        "its own on one thread, A B C A B C. Same function, loss, batch size, dropout and optimiser. "
        f"s: {seconds}. MiB: the most memory {memory}. Freed memory is kept for the next step, but by the program that "
        "says as it comes.",
        soft_wrap=True,
    )


def _steps(title: str, ours: Program, programs: Sequence[Program], on_gpu: bool) -> Table:
    table = new_table(title, "way", "s", "times ours", "MiB", "times")
    for program in programs:
        ratios = "", ""
        memory, own = (each.device_bytes if on_gpu else each.host_bytes for each in (program, ours))
        if program is not ours:
            ratios = _with_range(times_as_long(program, ours)), f"{memory / own:.2f}"
        name = program.name if program.keeps_memory else f"{program.name}, as it comes"
        seconds = _with_range([turn.step_s for turn in program.turns])
        table.add_row(name, seconds, ratios[0], f"{memory / 2**20:.0f}", ratios[1])
    return table


def _with_range(values: Sequence[float]) -> str:
    return f"{median(values):.2f} [{min(values):.2f}, {max(values):.2f}]"


def _parts(programs: Sequence[Program]) -> Table:
    table = new_table("in milliseconds", "way", *PARTS)
    for program in programs:
        medians = [median(s for turn in program.turns for s in turn.parts_s[part]) for part in PARTS]
        table.add_row(program.name, *(f"{1000 * seconds:.0f}" if seconds else "" for seconds in medians))
    return table


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
