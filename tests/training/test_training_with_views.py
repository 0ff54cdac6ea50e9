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
    """Views are replaced meanwhile: the second epoch's end is the first after which other views are trained on."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    refresh = ("--view_refresh.every_n_epochs", "1", "--view_refresh.measured", "12", "--view_refresh.replaced", "4")
    train(tiny_recipe, whole, "--trainer.max_epochs", "3", *refresh)
    log = capsys.readouterr().err
    assert f"{whole / 'views.png'}: 16 views of 12 depth frames; correlation with real frames" in log
    assert read_image(whole / "views.png").std() > 30
    told = json.loads((whole / "evaluation/last/metrics.json").read_text())["training"]["data"]["views"]
    assert {name: told[name] for name in ("count", "depth", "depth_frames", "share")} == {
        "count": 16, "depth": "sensor", "depth_frames": 12, "share": 0.5,
    }  # fmt: skip
    assert told["replaced"] == 8
    train(tiny_recipe, cut, "--trainer.max_epochs", "2", *refresh)
    train(tiny_recipe, cut, "--trainer.max_epochs", "3", *refresh, "--ckpt_path", str(cut / "checkpoints/last.ckpt"))
    states = [read_checkpoint(run / "checkpoints/last.ckpt") for run in (whole, cut)]
    assert states[0]["global_step"] == states[1]["global_step"] == 3 * 12 // 2
    torch.testing.assert_close(states[0]["state_dict"], states[1]["state_dict"], rtol=0, atol=0)
    rounds = states[0]["callbacks"]["ViewRefresh"]["rounds"]
    assert len(rounds) == 3
    assert all(len(each["rows"].unique()) == 4 and each["rows"].min() >= 12 for each in rounds)  # views, not frames


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        (["--data.num_workers", "1"], "data.num_workers: loader processes keep their first views. Set it to 0"),
        (
            ["--model.feature_cache_gib", "1", "--data.augmentation_draws", "1"],
            "model.feature_cache_gib: keeps features",
        ),
        (["--view_refresh.replaced", "600"], "view_refresh.replaced 600: must be 1 to half of measured, 512."),
    ],
)
def test_what_new_views_would_not_reach_is_refused(options, rule, tiny_recipe, tmp_path, capsys):
    with pytest.raises(SystemExit):
        train(tiny_recipe, tmp_path / "run", "--view_refresh.every_n_epochs", "1", *options)
    assert rule in capsys.readouterr().err
