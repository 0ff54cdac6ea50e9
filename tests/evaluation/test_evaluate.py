"""An evaluation reads its checkpoint once, and finds what Lightning's own test finds."""

import json
import runpy
import sys
from pathlib import Path

import lightning as L
import pytest
import torch

from mambaloc.errors import InputError
from mambaloc.evaluation import evaluate_checkpoint
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.evaluation.trained import load_trained
from mambaloc.metrics import summarize
from mambaloc.models import Checkpoint, checkpoint

TOOL = Path(__file__).parents[2] / "tools/evaluate.py"

pytestmark = pytest.mark.slow


@pytest.fixture
def reads(monkeypatch):
    """Each file that torch loads, and each that is hashed for a checkpoint's provenance."""
    loaded, hashed = [], []
    load, digest = torch.load, checkpoint.sha256
    monkeypatch.setattr(torch, "load", lambda path, **kwargs: loaded.append(path) or load(path, **kwargs))
    monkeypatch.setattr(checkpoint, "sha256", lambda path: hashed.append(path.name) or digest(path))
    return loaded, hashed


def test_an_evaluation_reads_its_checkpoint_once(trained, reads, tmp_path):
    path = trained / "checkpoints/best.ckpt"
    result = evaluate_checkpoint(Checkpoint.read(path), tmp_path / "out", accelerator="cpu")
    assert reads == ([path], ["config.yaml", "best.ckpt"])
    assert json.loads((tmp_path / "out/metrics.json").read_text())["metrics"] == result["metrics"]


def test_the_tool_reads_its_checkpoint_once(trained, reads, tmp_path, monkeypatch):
    path = trained / "checkpoints/best.ckpt"
    monkeypatch.setattr(sys, "argv", ["evaluate.py", str(path), "--out", str(tmp_path), "--accelerator", "cpu"])
    runpy.run_path(str(TOOL), run_name="__main__")
    assert reads == ([path], ["config.yaml", "best.ckpt"])
    metrics, by_training = (
        json.loads((folder / "metrics.json").read_text())["metrics"]
        for folder in (tmp_path, trained / "evaluation/best")
    )
    assert metrics == pytest.approx(by_training)


def test_errors_are_those_of_lightnings_own_test(trained):
    best = Checkpoint.read(trained / "checkpoints/best.ckpt")
    system, data = best.system(), best.data()
    table = localize_test_frames(system.train(), data, "cpu")
    assert not system.training
    quiet = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
    (expected,) = L.Trainer(accelerator="cpu", **quiet).test(best.system(), datamodule=best.data(), verbose=False)
    assert {f"test/{name}": value for name, value in summarize(table).items()} == pytest.approx(expected, rel=1e-6)
    assert table.index.tolist() == list(range(8))


def test_frames_of_another_size_are_refused(trained):
    best = Checkpoint.read(trained / "checkpoints/best.ckpt")
    with pytest.raises(InputError, match=r"data\.image_size \(28, 28\): .*best\.ckpt was trained on \(32, 32\)"):
        load_trained(best, best.data(image_size=28))
