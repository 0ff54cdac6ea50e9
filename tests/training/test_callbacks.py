"""What happens around training."""

import csv
import errno
import tempfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest
import torch

from mambaloc.callbacks import AtomicCheckpointIO, PoseProgressBar, TrajectoryPlot, WallClock, progress, wall_clock
from mambaloc.cli import main
from mambaloc.errors import InputError

CPU = SimpleNamespace(device=torch.device("cpu"), log=lambda *_, **__: None)


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test moves by hand."""
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr(wall_clock.time, "perf_counter", lambda: now.s)
    monkeypatch.setattr(wall_clock.time, "time", lambda: 1e9 + now.s)
    return now


def epoch(callback, trainer, clock, train_s, validation_s, afterwards_s):
    callback.on_train_epoch_start(trainer, CPU)
    clock.s += train_s
    callback.on_validation_start(trainer, CPU)
    clock.s += validation_s
    callback.on_validation_end(trainer, CPU)
    clock.s += 0.5  # the end of the training epoch
    callback.on_train_epoch_end(trainer, CPU)
    clock.s += afterwards_s  # checkpoints: nobody's


def trainer_at(position_error_m):
    metrics = {"val/position_error_m": torch.tensor(position_error_m)}
    return SimpleNamespace(sanity_checking=False, callback_metrics=metrics, global_step=40)


def test_wall_clock_keeps_training_apart_and_survives_a_resume(clock):
    first = WallClock(reach={"position_error_m": 0.2})
    clock.s += 7
    first.on_train_start(trainer_at(1.0), CPU)
    epoch(first, trainer_at(0.3), clock, train_s=10, validation_s=3, afterwards_s=50)
    assert first.state_dict() == {
        **{"setup_s": 7, "train_s": 10.5, "validation_s": 3},
        **{"reached_s": None, "reach": {"position_error_m": 0.2}},
        "history": [{"train_s": 10, "step": 40, "position_error_m": pytest.approx(0.3)}],
        "began_at": 1e9 + 107,
    }
    second = WallClock(reach={"position_error_m": 0.2})
    second.load_state_dict(first.state_dict())
    clock.s += 4
    second.on_train_start(trainer_at(1.0), CPU)
    epoch(second, trainer_at(0.2), clock, train_s=20, validation_s=1, afterwards_s=0)
    epoch(second, trainer_at(0.1), clock, train_s=20, validation_s=1, afterwards_s=0)
    assert second.seconds == {"setup_s": 11, "train_s": 51.5, "validation_s": 5}
    assert second.reached_s == 30.5
    assert second.began_at == 1e9 + 107, "of the first process"
    assert [reading["train_s"] for reading in second.history] == [10, 30.5, 51]


def test_wall_clock_refuses_a_metric_that_is_not_there(clock):
    callback = WallClock(reach={"position": 0.2})
    with pytest.raises(InputError, match="'position'"):
        callback.on_validation_end(trainer_at(0.3), CPU)


def test_progress_bar_shows_metres_and_degrees():
    names = {"train/loss": -1.25, "val/position_error_m": 0.1234, "val/rotation_error_deg": 5.678}
    trainer = SimpleNamespace(callback_metrics={name: torch.tensor(value) for name, value in names.items()})
    assert PoseProgressBar().get_metrics(trainer, CPU) == {"loss": "-1.250", "val": "0.123 m 5.68 deg"}


def test_progress_bar_draws_at_intervals_not_at_steps(monkeypatch):
    """Of a hundred steps a hundredth of a second apart: the first, one every tenth of a second, and the last."""
    drawn, now = [], SimpleNamespace(s=50.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now.s)
    monkeypatch.setattr(progress.RichProgressBar, "on_train_batch_end", lambda *args: drawn.append(args[-1]))
    bar, trainer = PoseProgressBar(), SimpleNamespace(num_training_batches=98)
    for batch_idx in range(98):
        bar.on_train_batch_end(trainer, CPU, None, None, batch_idx)
        now.s += 0.0100001
    assert drawn == [*range(0, 98, 10), 97]


@pytest.mark.slow
@pytest.mark.parametrize(
    "rhythm", [[], ["--trainer.val_check_interval", "3", "--trainer.check_val_every_n_epoch", "null"]]
)
@pytest.mark.parametrize(("patience", "epochs"), [(2, 3), (0, 5)])
def test_early_stopping_waits_for_its_patience(patience, epochs, rhythm, tiny_recipe, tmp_path):
    options = [*rhythm, "--early_stopping.patience", str(patience), "--early_stopping.min_delta", "1e9"]
    options += ["--best_checkpoint.save_top_k", "0"]
    main([str(tiny_recipe), *options, "--trainer.max_epochs", "5", "--trainer.default_root_dir", str(tmp_path / "run")])
    with (tmp_path / "run/metrics/version_0/metrics.csv").open() as file:
        assert max(int(row["epoch"]) for row in csv.DictReader(file)) + 1 == epochs


def test_trajectory_plot_is_drawn_when_due(trained, tmp_path):
    """In the second of three epochs, where every second is due; not in a first one."""
    first = SimpleNamespace(current_epoch=0, sanity_checking=False, fast_dev_run=False, default_root_dir=tmp_path)
    TrajectoryPlot(every_n_epochs=2).on_validation_epoch_end(first, CPU)
    assert not list(tmp_path.iterdir())
    image = cv2.imread(str(trained / "validation.png"))
    green, red = (
        cv2.inRange(image, *(tuple(c + d for c in bgr) for d in (-12, 12))) for bgr in ((80, 152, 26), (39, 48, 215))
    )
    assert green.any()
    assert red.any()


# --- checkpoints ------------------------------------------------------------------------------------------------------


def test_a_checkpoint_passes_through_no_other_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    AtomicCheckpointIO().save_checkpoint({"epoch": 1}, tmp_path / "run/last.ckpt")
    assert torch.load(tmp_path / "run/last.ckpt", weights_only=True) == {"epoch": 1}


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EACCES])  # Lightning keeps the latter to itself
def test_a_checkpoint_that_cannot_be_written_leaves_the_last(error, tmp_path, monkeypatch):
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint({"epoch": 1}, path)

    def half(partial: Path, content: bytes) -> None:
        partial.write_text("half of it")
        raise OSError(error, "no")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OSError, match="no"):
        AtomicCheckpointIO().save_checkpoint({"epoch": 2}, path)
    assert torch.load(path, weights_only=True) == {"epoch": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_only_an_epoch_with_validation_can_be_the_best(tiny_recipe, tmp_path, recwarn):
    """Guess: in an epoch without validation Lightning still has the value of the last one; it kept epoch 2 as well."""
    every = ["--best_checkpoint.save_top_k", "-1", "--best_checkpoint.filename", "{epoch}"]
    options = [*every, "--trainer.check_val_every_n_epoch", "2", "--trainer.max_epochs", "3"]
    main([str(tiny_recipe), *options, "--trainer.default_root_dir", str(tmp_path / "run")])
    kept = {path.name for path in (tmp_path / "run/checkpoints").iterdir()}
    assert kept == {"epoch=1.ckpt", "last.ckpt"}
    assert not [str(each.message) for each in recwarn if "could not find the monitored key" in str(each.message)]
