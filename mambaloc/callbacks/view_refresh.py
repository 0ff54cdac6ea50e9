"""Views where the network is worst, made by a second process while it trains."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray

from mambaloc import provenance
from mambaloc.data.views import SceneViews
from mambaloc.errors import InputError
from mambaloc.metrics import error_table
from mambaloc.synthesis import Spread, Views, make_views

_FOLDER = "views"


@dataclass(frozen=True)
class Round:
    """New views for the place of some: about which poses, (K, 4, 4), in which rows, (N,) of N views."""

    rows: NDArray[np.int64]
    world_from_cam: NDArray[np.float64]


class ViewRefresh(L.Callback):
    """Every so many epochs, replace views that the network localizes well by new ones about those that it does not.

    The network localizes ``measured`` views, augmented as in training. The ``replaced`` ones with the smallest errors
    make room; a process beside the training makes as many about the poses with the largest errors, in ``RUN/views``.
    They are trained on from the next round on, however fast the process was, so that a run depends on its seed alone,
    and goes on exactly when it is resumed.

    Args:
        every_n_epochs: a round; 0 keeps all views to the end.
        measured: views that are looked at in a round.
        replaced: of these, at most half; the process makes 256 at a time.

    Raises:
        InputError: for a number that is out of range; at the start of a training, where it cannot be.
    """

    def __init__(self, every_n_epochs: int = 0, measured: int = 1024, replaced: int = 256) -> None:
        if every_n_epochs < 0:
            raise InputError(f"view_refresh.every_n_epochs {every_n_epochs}: must be 0 or more. 0 replaces no view.")
        if not 0 < 2 * replaced <= measured:
            raise InputError(f"view_refresh.replaced {replaced}: must be 1 to half of measured, {measured // 2}.")
        self.every_n_epochs, self.measured, self.replaced = every_n_epochs, measured, replaced
        self.rounds: list[Round] = []  # the last one is being made
        self._pool: ProcessPoolExecutor | None = None
        self._coming: Future[Views] | None = None

    def state_dict(self) -> dict[str, Any]:
        """Return the rounds so far, which a resumed run repeats."""
        return {
            "rounds": [
                {"rows": torch.from_numpy(each.rows), "world_from_cam": torch.from_numpy(each.world_from_cam)}
                for each in self.rounds
            ]
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the rounds of a checkpoint."""
        self.rounds = [Round(each["rows"].numpy(), each["world_from_cam"].numpy()) for each in state_dict["rounds"]]

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Repeat the rounds of a resumed run.

        Raises:
            InputError: where batches are made or features kept in a way that new views would not reach.
        """
        if not self.every_n_epochs:
            return
        _refuse(trainer, pl_module)
        for number in range(len(self.rounds) - 1):
            self._put(trainer, number)
        if self.rounds:
            self._order(trainer)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """End a round and begin the next one, where one is due."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        if not self.every_n_epochs or (trainer.current_epoch + 1) % self.every_n_epochs or not len(data.view_rows):
            return
        if self._coming is not None:
            wait([self._coming])  # where the process has failed, the views are made here
            self._put(trainer, len(self.rounds) - 1)
        self.rounds.append(self._choose(trainer, pl_module))
        self._order(trainer)

    def teardown(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Stop the process beside the training."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = self._coming = None

    def _choose(self, trainer: L.Trainer, module: L.LightningModule) -> Round:
        """Localize views, and find the best and the worst."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        rng, views = np.random.default_rng((provenance.seed(), len(self.rounds))), data.view_rows
        rows = rng.choice(views, min(self.measured, len(views)), replace=False)
        batches = data.training_batches(rows, trainer.current_epoch, data.hparams["eval_batch_size"])
        module.eval()
        with torch.no_grad():
            errors = error_table(module, batches)
        module.train()
        error = errors.position_error_m / _made(trainer).source.median_depth_m + errors.rotation_error_deg.deg2rad()
        order = errors.index[error.argsort()].cpu().numpy()
        count = min(self.replaced, len(order) // 2)
        return Round(order[:count], data.poses_of_rows(order[-count:]))

    def _order(self, trainer: L.Trainer) -> None:
        """Let the process beside the training make the last round's views."""
        has_died = self._coming is not None and isinstance(self._coming.exception(), BrokenProcessPool)
        if self._pool is None or has_died:  # not forked: threads of a training may hold locks
            self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), torch.set_num_threads, (1,))
        self._coming = self._pool.submit(make_views, *self._arguments(trainer, len(self.rounds) - 1))

    def _put(self, trainer: L.Trainer, number: int) -> None:
        """Train on a round's views from now on."""
        views = make_views(*self._arguments(trainer, number))  # opens them, unless a moved run has lost them
        trainer.datamodule.replace_views(self.rounds[number].rows, views)  # type: ignore[attr-defined]

    def _arguments(self, trainer: L.Trainer, number: int) -> tuple[Any, ...]:
        """What :func:`~mambaloc.synthesis.make_views` takes to make a round's views."""
        wanted, made = self.rounds[number], _made(trainer)
        views: Views = made.views  # type: ignore[assignment]
        return (
            made.source, wanted.world_from_cam, views.intrinsics[0], views.images.shape[2:], len(wanted.rows),
            Path(trainer.default_root_dir) / _FOLDER, provenance.seed() + 1 + number, Spread(far=1.0),
            trainer.strategy.root_device,
        )  # fmt: skip


def _made(trainer: L.Trainer) -> SceneViews:
    made: SceneViews = trainer.datamodule.scene_views  # type: ignore[attr-defined]
    return made


def _refuse(trainer: L.Trainer, module: L.LightningModule) -> None:
    data = trainer.datamodule  # type: ignore[attr-defined]
    keeps_features = module.hparams.get("feature_cache_gib")
    for is_so, reason in (
        (len(data.each_scene()) > 1, "data.scenes: views are replaced in one scene. Name one"),
        (trainer.world_size > 1, "trainer.devices: views are replaced on one device. Choose one"),
        (data.hparams["num_workers"], "data.num_workers: loader processes keep their first views. Set it to 0"),
        (keeps_features, "model.feature_cache_gib: keeps features of views that are replaced. Set it to 0"),
    ):
        if is_so:
            raise InputError(f"{reason}, or view_refresh.every_n_epochs to 0.")
