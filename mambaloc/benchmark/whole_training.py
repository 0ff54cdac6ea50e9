"""A whole training in a process of its own: seconds from the process's start to an error, and to the end."""

from __future__ import annotations

import time
from dataclasses import dataclass

import lightning as L
from lightning.pytorch.utilities.types import STEP_OUTPUT

from mambaloc.benchmark.clock import now
from mambaloc.benchmark.footprint import in_a_process
from mambaloc.benchmark.setting import BenchmarkConfig
from mambaloc.errors import InputError


@dataclass(frozen=True)
class WholeTraining:
    """Seconds since the process was started, those of validation left out.

    Args:
        frames: that it trained on.
        steps: of the optimiser.
        sought_m: the median position error that was sought.
        first_step_s: to the end of the first step.
        reached_s: to the first validation with that error; None where there was none.
        ended_s: to the end of the last step.
        position_error_m: median over the validation frames at the end.
        rotation_error_deg: median rotation error on the test frames.
        selection: what the validation frames are.
    """

    frames: int
    steps: int
    sought_m: float
    first_step_s: float
    reached_s: float | None
    ended_s: float
    position_error_m: float
    rotation_error_deg: float
    selection: str


def measure_whole_training(setting: BenchmarkConfig, sought_m: float) -> WholeTraining:
    """Train as the setting says, from the start of a process to the last step.

    Raises:
        InputError: where :func:`check_whole_training` says so.
    """
    check_whole_training(setting)
    return in_a_process(_train, setting, time.time(), sought_m)


def check_whole_training(setting: BenchmarkConfig) -> None:
    """Check whether a setting can be trained to its end.

    Raises:
        InputError: where nothing is validated on, or no end is set.
    """
    if setting.data.get("validation") == "none":
        raise InputError("--reach: needs frames to validate on; add --overlay recipes/overlays/watched.yaml")
    if not {"max_steps", "max_epochs"} & set(setting.trainer):
        raise InputError("--reach: needs an end; add an overlay that sets trainer.max_steps or max_epochs")


class _Clock(L.Callback):
    """Seconds since a process began, without those of validation."""

    def __init__(self, started_at: float, sought_m: float) -> None:
        self.started_at, self.sought_m = started_at, sought_m
        self.first_step_s: float | None = None
        self.reached_s: float | None = None
        self.ended_s = 0.0
        self._validation_s = 0.0

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: STEP_OUTPUT, *_: object
    ) -> None:
        if self.first_step_s is None:
            self.first_step_s = self._seconds(pl_module)

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.ended_s = self._seconds(pl_module)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if self.reached_s is None and trainer.callback_metrics["val/position_error_m"] <= self.sought_m:
            self.reached_s = self.ended_s
        self._validation_s += self._seconds(pl_module) - self.ended_s

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.ended_s = self._seconds(pl_module)

    def _seconds(self, module: L.LightningModule) -> float:
        now(module.device)  # waits
        return time.time() - self.started_at - self._validation_s


def _train(setting: BenchmarkConfig, started_at: float, sought_m: float) -> WholeTraining:
    system, data = setting.build()
    clock = _Clock(started_at, sought_m)
    trainer = setting.fit(system, data, clock, limit_val_batches=1.0, max_steps=setting.trainer.get("max_steps", -1))
    (errors,) = trainer.validate(system, data, verbose=False)
    assert clock.first_step_s is not None
    return WholeTraining(
        len(data.frames("train")),
        trainer.global_step,
        sought_m,
        clock.first_step_s,
        clock.reached_s,
        clock.ended_s,
        errors["val/position_error_m"],
        errors["val/rotation_error_deg"],
        data.hparams["validation"],
    )
