"""What a CPU's settings are worth: ONNX Runtime's session options, and a training process's threads and memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import lightning as L
import onnxruntime
import torch
from onnxruntime import ExecutionMode, GraphOptimizationLevel, SessionOptions
from rich.console import Console
from rich.progress import track

from mambaloc.benchmark.footprint import in_a_process
from mambaloc.benchmark.latency import in_turns
from mambaloc.benchmark.report import new_table
from mambaloc.benchmark.speed import Setting, now, ratio
from mambaloc.errors import InputError
from mambaloc.export import contract_of, export_onnx

AS_IT_IS = "as it is"
_A_TURN = 10  # images, after those that warm up


def _entry(name: str, value: str) -> Callable[[SessionOptions], None]:
    return lambda options: options.add_session_config_entry(name, value)


def _attribute(name: str, value: object) -> Callable[[SessionOptions], None]:
    return lambda options: setattr(options, name, value)


SESSIONS: dict[str, Callable[[SessionOptions], None]] = {
    AS_IT_IS: lambda options: None,
    "one thread": _attribute("intra_op_num_threads", 1),
    "waiting threads sleep": _entry("session.intra_op.allow_spinning", "0"),
    "denormals as zero": _entry("session.set_denormal_as_zero", "1"),
    "no memory arena": _attribute("enable_cpu_mem_arena", False),
    "no memory pattern": _attribute("enable_mem_pattern", False),
    "branches side by side": _attribute("execution_mode", ExecutionMode.ORT_PARALLEL),
    "no layout optimisation": _attribute("graph_optimization_level", GraphOptimizationLevel.ORT_ENABLE_EXTENDED),
    "no optimisation": _attribute("graph_optimization_level", GraphOptimizationLevel.ORT_DISABLE_ALL),
}
"""What is changed of a session that runs on so many threads, by name."""

PROCESSES: dict[str, Mapping[str, str]] = {
    AS_IT_IS: {},
    "one thread": {"OMP_NUM_THREADS": "1"},
    "waiting threads sleep": {"OMP_WAIT_POLICY": "passive"},
    "freed memory given back, glibc's way": {"MALLOC_PERTURB_": "0"},  # any such variable keeps us from telling it
    "huge pages (Linux)": {"THP_MEM_ALLOC_ENABLE": "1"},
}
"""What is changed of a training process's environment, by name."""
COMPILED = "compiled steps"


@dataclass(frozen=True)
class SettingTimes:
    """Seconds by setting, an entry a repetition, all in turns.

    Args:
        inference: of one image in ONNX Runtime.
        training: of a step.
    """

    inference: dict[str, list[float]]
    training: dict[str, list[float]]


def measure_cpu_settings(setting: Setting, threads: int, steps: int = 8, repetitions: int = 5) -> SettingTimes:
    """Time inference and training under each setting.

    Args:
        setting: what is trained on what; its network, as it starts, is what runs in ONNX Runtime.
        threads: of ONNX Runtime.
        steps: of an epoch of training, of which each process runs two, and the second is timed.
        repetitions: processes a setting; twice as many sessions.

    Raises:
        InputError: for too few repetitions to tell a spread, or a device that is no CPU.
    """
    if repetitions < 4:
        raise InputError(f"--repetitions {repetitions}: quartiles need 4 or more")
    if setting.device.type != "cpu":
        raise InputError("cpu: measures a CPU; leave recipes/overlays/gpu.yaml out")
    inference = _inference(setting, threads, 2 * repetitions)
    forms = _forms(setting)
    training: dict[str, list[float]] = {name: [] for name in forms}
    turns = [name for _ in range(repetitions) for name in forms]
    for name in track(turns, "timing training steps", console=Console(stderr=True), transient=True):
        form, environment = forms[name]
        with _environment(environment):
            training[name].append(in_a_process(_step_s, form, steps))
    return SettingTimes(inference, training)


def print_cpu_settings(times: SettingTimes, threads: int, machine: str) -> None:
    """Print both tables, ratios first."""
    console = Console(highlight=False)
    for what, of_each in (
        (f"One image in ONNX Runtime on {threads} threads", times.inference),
        ("A training step", times.training),
    ):
        table = new_table(what, "setting", "times as long", "± IQR", "ms")
        for name, seconds in of_each.items():
            times_as_long, spread = ratio(seconds, of_each[AS_IT_IS])
            table.add_row(name, f"{times_as_long:.2f}", f"{spread:.2f}", f"{1000 * median(seconds):.2f}")
        console.print(table)
    console.print(machine, soft_wrap=True)


def _forms(setting: Setting) -> dict[str, tuple[Setting, Mapping[str, str]]]:
    """What is trained, and the variables of its process, by name."""
    compiled = replace(setting, model={**setting.model, "compile_mode": "default"})
    return {**{name: (setting, changes) for name, changes in PROCESSES.items()}, COMPILED: (compiled, {})}


def _inference(setting: Setting, threads: int, repetitions: int) -> dict[str, list[float]]:
    system, data = setting.build()
    image = torch.rand(1, 3, *data.crop).numpy()
    found: dict[str, list[float]] = {name: [] for name in SESSIONS}
    with TemporaryDirectory() as folder:
        path = Path(folder, "model.onnx")
        export_onnx(system, path, contract_of(system, data.hparams))
        names = list(SESSIONS)
        firsts = [turn % len(names) for turn in range(repetitions)]
        turns = [name for first in firsts for name in names[first:] + names[:first]]
        for name in track(turns, "timing sessions", console=Console(stderr=True), transient=True):
            # One session at a time: the threads of another would spin on for a while, and take a core.
            session = _session(path, threads, SESSIONS[name])
            taken = in_turns([lambda of=session: of.run(None, {"image": image})], _A_TURN, "cpu")  # type: ignore[misc]
            found[name].append(median(taken[0]))
            del session, taken
    return found


def _session(path: Path, threads: int, change: Callable[[SessionOptions], None]) -> onnxruntime.InferenceSession:
    options = SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 3, threads
    change(options)
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Variables of the processes that are started meanwhile."""
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


class _EpochClock(L.Callback):
    """Seconds of the last epoch."""

    seconds = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._start = now(pl_module.device)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.seconds = now(pl_module.device) - self._start


def _step_s(setting: Setting, steps: int) -> float:
    system, data = setting.build()
    clock = _EpochClock()
    setting.fit(system, data, clock, max_epochs=2, limit_train_batches=steps)
    return clock.seconds / steps
