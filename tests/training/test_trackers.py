"""Trackers of experiments that a recipe names: they log beside the run's own CSV and TensorBoard."""

import csv
from pathlib import Path

import pytest
import yaml
from lightning.pytorch.loggers import wandb as wandb_logger
from lightning_utilities.core.imports import RequirementCache

from mambaloc.cli import main

OVERLAYS = Path(__file__).parents[2] / "recipes/overlays"


def train(recipe, overlay, run):
    words = ["--trainer.max_epochs", "2", "--trainer.default_root_dir", str(run)]
    return main([str(recipe), str(overlay), *words])


def logged(path):
    """Each metric's last value in a CSV of a logger."""
    with path.open() as file:
        return {name: float(value) for row in csv.DictReader(file) for name, value in row.items() if value}


@pytest.mark.slow
def test_a_named_logger_comes_beside_the_runs_own(tiny_recipe, tmp_path):
    """Guess: a CSV has the same metrics whichever logger writes it."""
    named = {"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": {"save_dir": str(tmp_path / "named")}}
    overlay = tmp_path / "overlay.yaml"
    overlay.write_text(yaml.safe_dump({"trainer": {"logger+": [named]}}))
    train(tiny_recipe, overlay, tmp_path / "run")
    assert list((tmp_path / "run").glob("events.out.tfevents*"))
    (own,) = (tmp_path / "run/metrics").rglob("metrics.csv")
    (other,) = (tmp_path / "named").rglob("metrics.csv")
    assert logged(own) == logged(other)
    assert logged(own)["val/position_error_m"] > 0


@pytest.mark.slow
def test_mlflow_has_the_runs_metrics_and_parameters(tiny_recipe, tmp_path, monkeypatch):
    """Guesses: a folder may stand for a server (wrong of late, unless it is allowed); MLFLOW_TRACKING_URI is read when
    a run begins (wrong: when Lightning is imported).
    """
    mlflow = pytest.importorskip("mlflow", reason="needs the extra mlflow")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    store = (tmp_path / "store").as_uri()
    recipe = yaml.safe_load((OVERLAYS / "mlflow.yaml").read_text())
    recipe["trainer"]["logger+"][0]["init_args"]["tracking_uri"] = store
    (tmp_path / "overlay.yaml").write_text(yaml.safe_dump(recipe))
    train(tiny_recipe, tmp_path / "overlay.yaml", tmp_path / "run")
    client = mlflow.MlflowClient(store)
    (run,) = client.search_runs([client.get_experiment_by_name("mambaloc").experiment_id])
    (own,) = (tmp_path / "run/metrics").rglob("metrics.csv")
    expected = {name: value for name, value in logged(own).items() if name.startswith("val/")}
    assert {name: run.data.metrics[name] for name in expected} == pytest.approx(expected)
    assert run.data.params["backbone"] == "test_efficientnet"
    assert run.info.status == "FINISHED"


@pytest.mark.slow
def test_wandb_keeps_a_run_offline(tiny_recipe, tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="needs the extra wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_DIR", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    cli = train(tiny_recipe, OVERLAYS / "wandb.yaml", tmp_path / "run")
    run = cli.trainer.loggers[-1].experiment
    (own,) = (tmp_path / "run/metrics").rglob("metrics.csv")
    assert run.summary["val/position_error_m"] == pytest.approx(logged(own)["val/position_error_m"])
    assert run.config["backbone"] == "test_efficientnet"
    wandb.finish()
    assert len(list(tmp_path.glob("wandb/offline-run-*/*.wandb"))) == 1


def test_a_tracker_that_is_not_installed_is_one_line(tiny_recipe, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(wandb_logger, "_WANDB_AVAILABLE", RequirementCache("wandb>=9999"))
    with pytest.raises(SystemExit, match="2"):
        train(tiny_recipe, OVERLAYS / "wandb.yaml", tmp_path / "run")
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "wandb>=9999" in line
    assert not (tmp_path / "run").exists()
