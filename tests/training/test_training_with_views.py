"""Views in a whole run: trained on, resumed exactly, shown to a person, told in the results."""

import json

import pytest
import torch

from mambaloc.cli import main
from mambaloc.images import read_image
from mambaloc.models.weights import read_checkpoint
from mambaloc.synthesis import views


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch):
    monkeypatch.setattr(views, "PART", 16)


def train(recipe, run, *options):
    views = ("--data.views", "16", "--data.view_share", "0.5")
    main([str(recipe), "--trainer.default_root_dir", str(run), *views, *options])


def test_run_with_views_shows_and_tells_them_and_resumes_exactly(tiny_recipe, tmp_path, capsys):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    train(tiny_recipe, whole, "--trainer.max_epochs", "2")
    log = capsys.readouterr().err
    assert f"{whole / 'views.png'}: 16 views of 12 depth frames; correlation with real frames" in log
    assert read_image(whole / "views.png").std() > 30
    told = json.loads((whole / "evaluation/last/metrics.json").read_text())["training"]["data"]["views"]
    assert {name: told[name] for name in ("count", "depth", "depth_frames", "share")} == {
        "count": 16, "depth": "sensor", "depth_frames": 12, "share": 0.5,
    }  # fmt: skip
    train(tiny_recipe, cut, "--trainer.max_epochs", "1")
    train(tiny_recipe, cut, "--trainer.max_epochs", "2", "--ckpt_path", str(cut / "checkpoints/last.ckpt"))
    states = [read_checkpoint(run / "checkpoints/last.ckpt") for run in (whole, cut)]
    assert states[0]["global_step"] == states[1]["global_step"] == 2 * 12 // 2
    torch.testing.assert_close(states[0]["state_dict"], states[1]["state_dict"], rtol=0, atol=0)
