"""Training for so many minutes, whatever the machine."""

from __future__ import annotations

import math
import time
from typing import Any

import lightning as L

from mambaloc.errors import InputError

_RISE = 0.3  # share of the time in which the learning rate rises
_LOWEST, _LAST = 1 / 25, 1 / 250_000  # of the highest, where it begins and where it ends


class TimeBudget(L.Callback):
    """Train for so many minutes, under one cycle of the learning rate over the time that is left to it.

    Map, views and whatever else precedes the first step are part of the budget, and so is a reserve for tests and
    export. Steps then differ from run to run, and so does the network: for figures that others are to reach, set
    ``trainer.max_steps``. Recipes leave ``model.schedule`` at ``step`` under a budget; the cycle (Smith and Topin 2018)
    replaces it, and ``model.lr`` is its highest value. A resumed run has a budget of its own.

    Args:
        minutes: from ``began_s`` on, before any frame is read; None trains as the trainer says.
        reserve_s: seconds of the budget for tests and export at the end.

    Raises:
        InputError: for a budget that leaves no time to train.

    Attributes:
        began_s: reading of ``time.monotonic()`` from which the budget counts: when it was made, or, in a command,
            when the process began.
    """

    def __init__(self, minutes: float | None = None, reserve_s: float = 30.0) -> None:
        if minutes is not None and not reserve_s < 60 * minutes < math.inf:
            raise InputError(
                f"time_budget.minutes {minutes:g}: must be a finite number above {reserve_s / 60:g}, since the last "
                f"{reserve_s:g} s are for tests and export (time_budget.reserve_s). Give more minutes."
            )
        self.minutes, self.reserve_s = minutes, reserve_s
        self.began_s = time.monotonic()
        self._train_began = self._ends = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take what the start has left of the budget.

        Raises:
            InputError: where nothing is left.
        """
        if self.minutes is None or trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        self._train_began, self._ends = time.monotonic(), self.began_s + 60 * self.minutes - self.reserve_s
        if self._ends <= self._train_began:
            started_s = self._train_began - self.began_s
            enough = math.ceil((started_s + self.reserve_s) / 6) / 10
            raise InputError(
                f"time_budget.minutes {self.minutes:g}: leaves no time to train. {started_s:.0f} s went by before the "
                f"first step, and {self.reserve_s:g} s are for tests and export (time_budget.reserve_s). Give more "
                f"than {enough:g} minutes; frames, map and views are kept, so the next run starts sooner."
            )
        groups = trainer.optimizers[0].param_groups  # of a resumed run they are where the last cycle ended
        self._highest = [group.get("initial_lr", group["lr"]) for group in groups]

    def on_train_batch_start(self, trainer: L.Trainer, *_: Any) -> None:
        """Set the learning rate that belongs to this time."""
        if not self._ends:
            return
        factor = one_cycle((time.monotonic() - self._train_began) / (self._ends - self._train_began))
        for group, highest in zip(trainer.optimizers[0].param_groups, self._highest, strict=True):
            group["lr"] = highest * factor

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Stop once the time is over."""
        if not self._ends:
            return
        left_s = self._ends - time.monotonic()
        pl_module.log("time/left_s", left_s, logger=False)
        if trainer.strategy.broadcast(left_s <= 0):  # all devices stop after the same step
            trainer.should_stop = True


def one_cycle(share: float) -> float:
    """Learning rate as a factor of the highest, at a share of the training, as PyTorch's ``OneCycleLR`` has it."""
    share = min(max(share, 0.0), 1.0)
    if share < _RISE:
        return _between(_LOWEST, 1.0, share / _RISE)
    return _between(1.0, _LAST, (share - _RISE) / (1 - _RISE))


def _between(start: float, end: float, way: float) -> float:
    return end + (start - end) * (1 + math.cos(math.pi * way)) / 2
