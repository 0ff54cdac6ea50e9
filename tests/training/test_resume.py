"""A resumed run continues exactly, however it was stopped."""

import csv
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from mambaloc.cli import main
from mambaloc.models.weights import read_checkpoint

REPOSITORY = Path(__file__).parents[2]


def epochs_of(run):
    """Logged values of each epoch."""
    epochs = {}
    for log in sorted((run / "metrics").glob("version_*/metrics.csv")):
        with log.open() as file:
            for row in csv.DictReader(file):
                epochs.setdefault(int(row["epoch"]), {}).update({k: float(v) for k, v in row.items() if v})
    return epochs


def is_logged(run):
    """Whether the training of an epoch is in the log."""
    return any("train/loss" in log.read_text() for log in (run / "metrics").glob("version_*/metrics.csv"))


COMPARED = ("train/loss", "train/lr", "train/s_position", "val/loss", "val/position_error_m", "val/rotation_error_deg")


def assert_equal_runs(run, other):
    logs = [{e: {k: v[k] for k in COMPARED} for e, v in epochs_of(r).items()} for r in (run, other)]
    assert logs[0] == logs[1]
    for name in ("best", "last"):
        states = [read_checkpoint(r / "checkpoints" / f"{name}.ckpt") for r in (run, other)]
        assert states[0]["epoch"] == states[1]["epoch"]
        torch.testing.assert_close(states[0]["state_dict"], states[1]["state_dict"], rtol=0, atol=0)


def train(recipe, run, *options):
    main([str(recipe), "--trainer.default_root_dir", str(run), *options])


def test_resumed_run_equals_an_uninterrupted_one(trained, tiny_recipe, tmp_path):
    cut = tmp_path / "cut"
    train(tiny_recipe, cut, "--trainer.max_epochs", "2")
    assert set(epochs_of(cut)) == {0, 1}
    main([str(tiny_recipe), "--ckpt_path", str(cut / "checkpoints/last.ckpt"), "--trainer.max_epochs", "3"])

    epochs = epochs_of(trained)
    assert set(epochs) == {0, 1, 2}
    assert epochs[2]["train/lr"] == pytest.approx(epochs[1]["train/lr"] / 10)  # the step falls where the run was cut
    assert_equal_runs(cut, trained)
    clocks = [read_checkpoint(cut / "checkpoints/last.ckpt")["callbacks"]["WallClock"]["train_s"]]
    assert clocks[0] > epochs_of(cut)[1]["time/train_s"]  # it goes on from where it was


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_stopped_run_leaves_a_checkpoint_that_resumes_exactly(how, tiny_recipe, tmp_path):
    stopped, whole = tmp_path / "stopped", tmp_path / "whole"
    command = [sys.executable, REPOSITORY / "tools/train.py", tiny_recipe]
    options = ["--trainer.max_epochs", "500", "--trainer.default_root_dir", stopped]
    heed = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731  a shell's background jobs ignore it
    process = subprocess.Popen([*command, *options], stderr=subprocess.PIPE, preexec_fn=heed)
    last = stopped / "checkpoints/last.ckpt"
    deadline = time.monotonic() + 120
    # An epoch's log is written after its checkpoint; what is compared below is in both.
    while not (last.exists() and is_logged(stopped)) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(how)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode != 0
    if how == signal.SIGINT:
        assert f"--ckpt_path {last}".encode() in stderr
        assert b"Traceback" not in stderr

    epochs = ["--trainer.max_epochs", str(read_checkpoint(last)["epoch"] + 3)]
    main([str(tiny_recipe), "--ckpt_path", str(last), *epochs])
    train(tiny_recipe, whole, *epochs)
    assert_equal_runs(stopped, whole)
