"""Training for so many minutes, and the bundle that it ends with."""

import re
import time
from types import SimpleNamespace

import pytest
import torch

from mambaloc.callbacks import PoseProgressBar, TimeBudget, time_budget
from mambaloc.callbacks.time_budget import one_cycle
from mambaloc.cli import main
from mambaloc.errors import InputError
from mambaloc.models.weights import read_checkpoint
from mambaloc.runtime.bundle import verify_bundle


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test moves by hand."""
    now = SimpleNamespace(s=0.0)
    monkeypatch.setattr(time_budget.time, "monotonic", lambda: now.s)
    return now


def test_the_cycle_is_pytorchs():
    steps, highest = 201, 0.4
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, highest, steps, pct_start=0.3)
    for step in range(steps):
        if step:
            optimizer.step()
            schedule.step()
        rise = 0.3 * steps - 1  # where theirs is highest
        share = 0.3 * step / rise if step < rise else 0.3 + 0.7 * (step - rise) / (steps - 1 - rise)
        assert highest * one_cycle(share) == pytest.approx(optimizer.param_groups[0]["lr"], rel=1e-6, abs=1e-9)


def test_the_time_before_the_first_step_and_the_reserve_are_part_of_the_budget(clock):
    logged = {}
    module = SimpleNamespace(log=lambda name, value, **_: logged.update({name: value}))
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.5)
    optimizer.param_groups[0].update(initial_lr=0.5, lr=1e-6)  # as a resumed run has it
    alone = SimpleNamespace(broadcast=lambda value: value)
    trainer = SimpleNamespace(optimizers=[optimizer], should_stop=False, fast_dev_run=0, strategy=alone)
    budget, rates = TimeBudget(minutes=2, reserve_s=20), []
    clock.s = 40.0  # a map and views
    budget.on_train_start(trainer, module)
    for clock.s in (40.0, 58.0, 79.0, 99.0, 100.0):
        budget.on_train_batch_start(trainer, module)
        rates.append(optimizer.param_groups[0]["lr"])
        assert not trainer.should_stop
        budget.on_train_batch_end(trainer, module)
    assert trainer.should_stop
    assert rates[0] == pytest.approx(0.5 / 25)
    assert rates[1] == pytest.approx(0.5)
    assert rates[1] > rates[2] > rates[3] > rates[4] > 0
    assert logged == {"time/left_s": 0.0}


def test_a_budget_ends_a_run_that_has_no_other_end(tiny_recipe, tmp_path, capsys):
    """Its progress bar names the epoch alone. Guess: Lightning's draws ``Epoch 0/-2``."""
    options = ["--trainer.max_epochs", "-1", "--time_budget.minutes", "0.25", "--time_budget.reserve_s", "1"]
    main([str(tiny_recipe), *options, "--trainer.default_root_dir", str(tmp_path / "run")])
    assert read_checkpoint(tmp_path / "run/checkpoints/last.ckpt")["global_step"] > 5
    assert (tmp_path / "run/evaluation/last/metrics.json").is_file()
    drawn = re.findall(r"Epoch (\S+)", capsys.readouterr().out)
    assert drawn
    assert all(epoch.isdecimal() for epoch in drawn)


def test_a_budget_that_is_used_up_before_the_first_step(clock):
    """35 s of start and 30 s of reserve are 1.083 minutes."""
    budget, clock.s = TimeBudget(minutes=1), 35.0
    parts = r"35 s went by before the first step, and 30 s are for tests and export \(time_budget\.reserve_s\)"
    line = rf"^time_budget\.minutes 1: leaves no time to train\. {parts}\. Give more than 1\.1 minutes; "
    with pytest.raises(InputError, match=line):
        budget.on_train_start(SimpleNamespace(fast_dev_run=0), SimpleNamespace())
    for minutes in (0.2, 0.5, float("inf"), float("nan")):
        with pytest.raises(InputError, match=r"finite number above 0\.5, since the last 30 s are for tests and export"):
            TimeBudget(minutes=minutes)


def test_a_budget_counts_from_the_start_of_the_command(tiny_recipe, tmp_path, capsys):
    options = ["--time_budget.minutes", "1", "--trainer.default_root_dir", str(tmp_path / "run")]
    with pytest.raises(SystemExit, match="2"):
        main([str(tiny_recipe), *options], began_s=time.monotonic() - 61)
    assert "s went by before the first step, and 30 s are for tests and export" in capsys.readouterr().err


def test_the_progress_bar_shows_the_seconds_left():
    trainer = SimpleNamespace(callback_metrics={"time/left_s": torch.tensor(34.6)})
    assert PoseProgressBar().get_metrics(trainer, SimpleNamespace()) == {"left": "35 s"}


def test_a_run_ends_with_a_bundle_of_model_and_map(tiny_recipe, den, tmp_path):
    options = ["--data.root", str(den), "--data.scene", "den", "--data.validation", "none"]
    options += ["--map.enabled", "true", "--map.width", "160", "--map.key_frames", "30"]
    options += ["--onnx_export.enabled", "true", "--onnx_export.bundle", "true"]
    run = tmp_path / "run"
    main([str(tiny_recipe), *options, "--trainer.max_epochs", "1", "--trainer.default_root_dir", str(run)])
    assert {each.file for each in verify_bundle(run / "bundle") if each.within} == {"model.onnx", "map.safetensors"}
    (run / "bundle" / "old").write_text("of an earlier run")
    last = str(run / "checkpoints/last.ckpt")
    main([str(tiny_recipe), *options, "--trainer.max_epochs", "2", "--ckpt_path", last])
    assert not (run / "bundle" / "old").exists()
    assert not (run / "model.onnx").exists()
