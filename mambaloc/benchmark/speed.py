"""Training steps beside those of published programs: seconds and memory, each program in processes of its own.

Ours is measured as it is used: ``Trainer.fit`` on a :class:`~mambaloc.data.PoseDataModule`. The published program
(:mod:`mambaloc.benchmark.reference`) trains the same function with the same dropout and batch. Processes take turns on
one thread each, and both sides keep freed memory (:mod:`mambaloc.memory`); the published program is measured once more
as it comes, without that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from rich.console import Console
from rich.progress import Progress

from mambaloc.benchmark.clock import StepClock, TrainerClock
from mambaloc.benchmark.footprint import device_peak_bytes, in_a_process, peak_bytes
from mambaloc.benchmark.reference import ReferenceLoop, check_loaded, published_form
from mambaloc.benchmark.setting import BenchmarkConfig
from mambaloc.errors import InputError
from mambaloc.memory import keep_freed_memory
from mambaloc.models import LitPoseRegressor

OURS, REFERENCE = "ours", "published"
PUBLISHED_DROPOUT = 0.1
"""On attention weights, in TransPoseNet's program."""


@dataclass(frozen=True)
class Turn:
    """What one process measured.

    Args:
        parts_s: seconds of each part of each step, the first step left out; on a CPU, of the process's own computing.
        host_bytes: largest resident memory of the process, libraries and mapped pages included.
        device_bytes: largest memory that tensors took on a GPU; 0 without one.
    """

    parts_s: dict[str, list[float]]
    host_bytes: int
    device_bytes: int

    @property
    def step_s(self) -> float:
        """Median over the steps."""
        return median(sum(step) for step in zip(*self.parts_s.values(), strict=True))


@dataclass(frozen=True)
class Program:
    """A training program, and its turns.

    Args:
        name: ours or the published.
        batch: images a step.
        attention_dropout: probability; None for a network without such weights.
        keeps_memory: whether it keeps freed memory for its next step.
        turns: a process each.
    """

    name: str
    batch: int
    attention_dropout: float | None
    keeps_memory: bool
    turns: tuple[Turn, ...] = ()

    @property
    def host_bytes(self) -> int:
        """The most of its turns."""
        return max(turn.host_bytes for turn in self.turns)

    @property
    def device_bytes(self) -> int:
        """The most of its turns."""
        return max(turn.device_bytes for turn in self.turns)

    def is_beside(self, other: Program) -> bool:
        """Whether both train on as many images with the same dropout."""
        return (self.batch, self.attention_dropout) == (other.batch, other.attention_dropout)


def times_as_long(theirs: Program, ours: Program) -> list[float]:
    """How many times as long as ours a published program's step takes, by turns."""
    return [other.step_s / own.step_s for other, own in zip(theirs.turns, ours.turns, strict=True)]


def measure_speed(
    setting: BenchmarkConfig, batches: Sequence[int] = (), steps: int = 3, turns: int = 3
) -> list[Program]:
    """Train some steps in each program, batch size and dropout.

    Args:
        setting: what is trained on what.
        batches: images a step; the setting's own unless given.
        steps: of a turn that are timed, after one that warms up.
        turns: of each program, one after the other: A B C A B C.

    Raises:
        InputError: for a scene with fewer frames than a step takes, or that the published loop cannot load.
    """
    system, data = setting.build()
    batches = batches or [data.hparams["batch_size"]]
    data.setup("fit")
    if max(batches) > (frames := len(data.frames("train"))):
        raise InputError(f"--batch {max(batches)}: the scene has {frames} frames to train on. Give fewer.")
    if published_form(system) is not None:
        check_loaded(data)
    measured = []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        for programs in _side_by_side(system, batches):
            title = f"{programs[0].batch} images"
            for _ in progress.track(range(turns), description=title):
                programs = [
                    replace(program, turns=(*program.turns, in_a_process(measure_turn, setting, program, steps)))
                    for program in programs
                ]
            measured += programs
    return measured


def _side_by_side(system: LitPoseRegressor, batches: Sequence[int]) -> list[list[Program]]:
    """The programs that take turns: ours and, where there is one, the published, by batch and dropout."""
    dropouts = (0.0, PUBLISHED_DROPOUT) if "attention_dropout" in system.hparams else (None,)
    ways = [(OURS, True)]
    if published_form(system) is not None:
        ways += [(REFERENCE, True), (REFERENCE, False)]
    return [[Program(name, batch, dropout, keeps) for name, keeps in ways] for batch in batches for dropout in dropouts]


def measure_turn(setting: BenchmarkConfig, program: Program, steps: int) -> Turn:
    """Train so many steps and one before them in this process, which keeps its settings: give it one of its own."""
    torch.set_num_threads(1)
    if program.keeps_memory:
        keep_freed_memory()
    model = {} if program.attention_dropout is None else {"attention_dropout": program.attention_dropout}
    setting = replace(setting, model={**setting.model, **model})
    system, data = setting.build(batch_size=program.batch)
    data.setup("fit")
    if program.name == OURS:
        timer = TrainerClock()
        whole_batches = len(data.frames("train")) // program.batch
        setting.fit(system, data, timer, limit_train_batches=whole_batches, max_epochs=-1, max_steps=1 + steps)
        clock = timer.clock
    else:
        clock = StepClock(setting.device)
        ReferenceLoop(system, data, setting.device).train(1 + steps, clock)
    parts_s = {part: seconds[1:] for part, seconds in clock.parts_s.items()}
    return Turn(parts_s, peak_bytes(), device_peak_bytes())
