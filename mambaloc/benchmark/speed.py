"""Training and evaluation speed in one run, beside the loop and the network of published research code.

Ours is measured as it is used: ``Trainer.fit`` on a :class:`~mambaloc.data.PoseDataModule`, timed by a callback. After
each of its epochs the reference (:mod:`mambaloc.benchmark.reference`) takes its turn: both meet the same machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median, quantiles
from typing import Any

import lightning as L
import torch
from rich.console import Console
from rich.progress import Progress

from mambaloc.benchmark.reference import Published, ReferenceLoop
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.files import read_yaml
from mambaloc.models import LitPoseRegressor, create_model
from mambaloc.models.transposenet import LitTransPoseNet

PARTS = ("load", "augment", "forward", "loss", "backward", "optimiser", "trainer")
OURS, REFERENCE, LOOP_ALONE = "ours", "reference", "reference loop, our network"


@dataclass(frozen=True)
class Setting:
    """A system on a scene, with whatever a recipe may say of them.

    Args:
        system: its name.
        model: arguments of the system.
        data: of :class:`~mambaloc.data.PoseDataModule`.
        trainer: of Lightning's Trainer.
    """

    system: str
    model: Mapping[str, Any] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)
    trainer: Mapping[str, Any] = field(default_factory=dict)

    def with_overlay(self, path: Path) -> Setting:
        """Put what an overlay says over this; it has nothing but these three sections to say.

        Raises:
            InputError: for a file that is no overlay.
        """
        said = read_yaml(path, "see recipes/overlays/", "give an overlay, as recipes/overlays/ holds them")
        if not isinstance(said, dict) or not set(said) & {"model", "data", "trainer"}:
            raise InputError(f"{path}: says nothing of model, data or trainer; give one of recipes/overlays/")
        model = _section(path, said, "model")
        return replace(
            self,
            model={**self.model, **_section(path, model, "init_args")},
            data={**self.data, **_section(path, said, "data")},
            trainer={**self.trainer, **_section(path, said, "trainer")},
        )

    def build(self, **data: Any) -> tuple[LitPoseRegressor, PoseDataModule]:
        """Make the system and its scene, whose options ``data`` changes."""
        options = {**self.data, **data}
        image_size = options.get("image_size", 224)
        return create_model(self.system, image_size=image_size, **self.model), PoseDataModule(**options)

    @property
    def device(self) -> torch.device:
        """Where it is trained."""
        return _trainer(self).strategy.root_device

    def fit(self, system: LitPoseRegressor, data: PoseDataModule, callback: L.Callback, **options: Any) -> L.Trainer:
        """Train with nothing beside the callback, and without validation unless told."""
        options = {"num_sanity_val_steps": 0, "limit_val_batches": 0, "max_steps": -1, **options}
        trainer = _trainer(self, callbacks=[callback], **options)
        trainer.fit(system, data)
        return trainer


def _section(path: Path, said: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    section = said.get(name) or {}
    if not isinstance(section, dict) or not all(isinstance(key, str) for key in section):
        raise InputError(f"{path}: {name} is no mapping of names; indent what belongs to it")
    return section


@dataclass(frozen=True)
class Speed:
    """What one run measured; each list has an entry a repetition.

    Args:
        batch: images a step.
        training: images a second of training, by way.
        batches: ours, by images a step.
        evaluation: images a second of evaluation, by way.
        parts: seconds of a step's parts, by way; on a GPU, each waited for.
    """

    batch: int
    training: dict[str, list[float]]
    batches: dict[int, list[float]]
    evaluation: dict[str, list[float]]
    parts: dict[str, dict[str, list[float]]]


def ratio(ours: Sequence[float], theirs: Sequence[float]) -> tuple[float, float]:
    """Ratio of medians, and the interquartile range of the ratios of neighbouring repetitions."""
    low, _, high = quantiles([a / b for a, b in zip(ours, theirs, strict=True)], n=4)
    return median(ours) / median(theirs), high - low


def measure_speed(
    setting: Setting, batches: Sequence[int] = (16, 32), steps: int = 4, repetitions: int = 5, workers: int = 2
) -> Speed:
    """Measure training, evaluation, and the parts of a step.

    Args:
        setting: what is trained on what.
        batches: other numbers of images a step to try.
        steps: of a repetition.
        repetitions: timed, after one that warms up.
        workers: loader processes of the reference.

    Raises:
        InputError: where :func:`check_speed` says so.
    """
    system, data = setting.build()
    check_speed(data, batches, steps, repetitions)
    device = setting.device
    published = Published(system) if isinstance(system, LitTransPoseNet) else None
    loops = {REFERENCE: ReferenceLoop(system, data, published, steps, device, workers)}
    if published is not None:
        loops[LOOP_ALONE] = ReferenceLoop(system, data, None, steps, device, workers)
    batch = data.hparams["batch_size"]
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("measuring training", total=(1 + repetitions) * (1 + len(batches)))
        turns = _Turns(loops, batch * steps, lambda: progress.advance(task))
        setting.fit(system, data, turns, limit_train_batches=steps, max_epochs=1 + repetitions)
        others = {}
        for size in batches:
            alone = _Turns({}, size * steps, lambda: progress.advance(task))
            larger, scene = setting.build(batch_size=size)
            setting.fit(larger, scene, alone, limit_train_batches=steps, max_epochs=1 + repetitions)
            others[size] = alone.rates[OURS]
        progress.update(task, description="measuring evaluation and parts")
        clock = _PartClock()
        setting.fit(system, data, clock, limit_train_batches=steps, max_epochs=1)
        parts = {OURS: clock.seconds, REFERENCE: _reference_parts(loops[REFERENCE])}
        images = min(steps * batch, len(data.frames("val")))
        evaluation = _evaluation(setting, system, data, loops[REFERENCE], images, repetitions)
    return Speed(batch, turns.rates, {batch: turns.rates[OURS], **others}, evaluation, parts)


def check_speed(data: PoseDataModule, batches: Sequence[int], steps: int, repetitions: int) -> None:
    """Tell whether a scene's speed can be measured; decodes its frames, which is nobody's first step.

    Raises:
        InputError: for too few repetitions to tell a spread, or a scene with too few frames.
    """
    if repetitions < 4:
        raise InputError(f"--repetitions {repetitions}: quartiles need 4 or more")
    if steps < 2:
        raise InputError(f"--steps {steps}: the first warms up; give 2 or more")
    if data.hparams["validation"] == "none":
        raise InputError("speed: evaluation needs frames; set data.validation to block")
    data.setup("fit")
    frames, most = len(data.frames("train")), max([data.hparams["batch_size"], *batches])
    if steps * most > frames:
        raise InputError(f"--steps {steps}: in batches of {most} they need more than the scene's {frames} frames")


class _Turns(L.Callback):
    """Images a second of each epoch, and after it of as many steps of each reference; the first epoch warms up."""

    def __init__(self, loops: dict[str, ReferenceLoop], images: int, on_turn: Callable[[], None]) -> None:
        self.loops, self.images, self.on_turn = loops, images, on_turn
        self.rates: dict[str, list[float]] = {OURS: [], **{name: [] for name in loops}}

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._start = now(pl_module.device)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        taken = {OURS: now(pl_module.device) - self._start}
        for name, loop in self.loops.items():
            start = now(loop.device)
            loop.train()
            taken[name] = now(loop.device) - start
        if trainer.current_epoch:
            for name, seconds in taken.items():
                self.rates[name].append(self.images / seconds)
        self.on_turn()


class _PartClock(L.Callback):
    """Seconds of each part of a step, the first step left out."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = {part: [] for part in PARTS}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        data, self.device = trainer.datamodule, pl_module.device  # type: ignore[attr-defined]
        self._marks: dict[str, float] = {}
        augment = data.on_after_batch_transfer

        def timed(*args: Any) -> Any:
            self._mark("load")
            batch = augment(*args)
            self._mark("augment")
            return batch

        data.on_after_batch_transfer = timed
        self._hooks = [
            pl_module.loss.register_forward_pre_hook(lambda *_: self._mark("forward")),  # type: ignore[union-attr]
            pl_module.loss.register_forward_hook(lambda *_: self._mark("loss")),  # type: ignore[union-attr]
        ]
        self._last = now(self.device)

    def on_train_batch_start(self, trainer: L.Trainer, *_: Any) -> None:
        self._mark("trainer")

    def on_before_backward(self, *_: Any) -> None:
        self._mark("trainer")

    def on_after_backward(self, *_: Any) -> None:
        self._mark("backward")

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *rest: Any) -> None:
        self._mark("optimiser")
        if rest[-1]:  # not of the first batch
            for part in PARTS:
                self.seconds[part].append(self._marks.get(part, 0.0))
        self._marks = {}

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        del trainer.datamodule.on_after_batch_transfer  # type: ignore[attr-defined]
        for hook in self._hooks:
            hook.remove()

    def _mark(self, part: str) -> None:
        """What lies since the last mark was this part."""
        at = now(self.device)
        self._marks[part] = self._marks.get(part, 0.0) + at - self._last
        self._last = at


def _reference_parts(loop: ReferenceLoop) -> dict[str, list[float]]:
    """Seconds of each part of the reference's steps, the first left out; its loader augments, too."""
    seconds: dict[str, list[float]] = {part: [] for part in PARTS}
    last = now(loop.device)

    def mark(part: str) -> None:
        nonlocal last
        at = now(loop.device)
        seconds[part].append(at - last)
        last = at

    loop.train(mark)
    return {part: of_each[1:] for part, of_each in seconds.items() if of_each}


def _evaluation(
    setting: Setting, system: LitPoseRegressor, data: PoseDataModule, loop: ReferenceLoop, images: int, repetitions: int
) -> dict[str, list[float]]:
    """Images a second: ours by ``Trainer.validate``, the reference an image at a time, in turns."""
    rates: dict[str, list[float]] = {OURS: [], REFERENCE: []}
    size, loader = data.hparams["eval_batch_size"], loop.loader("val", 1, images)
    for repetition in range(1 + repetitions):
        clock = _ValidationClock()
        _trainer(setting, callbacks=[clock], limit_val_batches=-(-images // size)).validate(system, data, verbose=False)
        start = now(loop.device)
        theirs = loop.evaluate(loader) / (now(loop.device) - start)
        if repetition:
            rates[OURS].append(clock.images / clock.seconds)
            rates[REFERENCE].append(theirs)
    return rates


class _ValidationClock(L.Callback):
    """Seconds of a validation, and its images."""

    images, seconds = 0, 0.0

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._start = now(pl_module.device)

    def on_validation_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *rest: Any) -> None:
        self.images += len(rest[1].index)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.seconds = now(pl_module.device) - self._start


def now(device: torch.device) -> float:
    """Seconds on a clock, once the device has done what it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _trainer(setting: Setting, **options: Any) -> L.Trainer:
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    told = {"accelerator": "cpu", "devices": 1, **setting.trainer, "enable_model_summary": False, **quiet, **options}
    return L.Trainer(**{"max_epochs": 1, **told})
