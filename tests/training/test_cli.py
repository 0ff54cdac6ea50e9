"""What a user types, right and wrong."""

import csv
import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lightning import Trainer

import mambaloc
from mambaloc.cli import main, recipe_arguments
from mambaloc.errors import InputError
from mambaloc.refusals import report_refusals

REPOSITORY = Path(__file__).parents[2]


def tool(name, *words):
    """Run a tool in this process, which has imported what it needs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(REPOSITORY / "tools" / f"{name}.py"), run_name="__main__")


def test_recipes_come_first_and_become_configs(tmp_path):
    a, b = tmp_path / "a.yaml", tmp_path / "b.yml"
    a.touch(), b.touch()
    assert recipe_arguments([str(a), str(b), "--model.lr", "1"]) == [
        *("fit", "--config", str(a), "--config", str(b)),
        *("--model.lr", "1"),
    ]
    assert recipe_arguments(["test", str(a)]) == ["test", "--config", str(a)]


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        ([], "a recipe comes first"),
        (["--model.lr", "1", "a.yaml"], "a recipe comes first"),
        (["missing.yaml"], "no such recipe"),
        (["a.yaml", "--model.lr", "1", "b.yaml"], "come before the options"),
    ],
)
def test_misplaced_recipe_is_refused(words, rule, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.yaml").touch(), (tmp_path / "b.yaml").touch()
    with pytest.raises(InputError, match=rule):
        recipe_arguments(words)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--data.scene", "null"], ["data.scene null: needs a value", "the default, heads"]),
        (["--model.lr", "null"], ["model.lr null: needs a value", "the default, 0.0001"]),
        (["--data.scene", "fire"], ["fire", "mambaloc download 7scenes fire"]),
        (["--model.gis", "both"], ["gis"]),
        (["--model", "LitMambaLok"], ["LitMambaLok", "LitMambaLoc"]),
        (["--model.learning_rate", "1"], ["learning_rate"]),
        (["--model.backbone", "resnet10x"], ["resnet10x", "resnet10t"]),
        (["--ckpt_path", "nothing.ckpt"], ["nothing.ckpt"]),
        (["--data.image_size", "64"], ["short_side"]),
        (["--retrieval", "true"], ["retrieval: needs a pretrained backbone", "model.backbone_weights"]),
        (["--trainer.enable_checkpointing", "false"], ["enable_checkpointing", "save_top_k"]),
        (["--trainer.strategy", "nonsense"], ["trainer.strategy: Lightning refuses it", "ddp_spawn"]),
        (["--trainer.val_check_interval", "100"], ["trainer.val_check_interval: Lightning refuses it", "(100)"]),
        (["--trainer.check_val_every_n_epoch", "0"], ["trainer.check_val_every_n_epoch: Lightning", "modulo by zero"]),
        (["--best_checkpoint.mode=nonsense"], ["best_checkpoint.mode: Lightning refuses it", "min, max"]),
        (["--trainer.precision", "bf16-true"], ["trainer.precision bf16-true", "Give bf16-mixed"]),
        (["--trainer.callbacks+", "nonsense"], ["trainer.callbacks", "nonsense"]),
    ],
)
def test_mistake_is_one_line_and_exit_code_2(options, words, tiny_recipe, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([str(tiny_recipe), *options])
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert all(word in error for word in words), error
    assert len(error.strip().splitlines()) == 1


def test_only_what_lightning_refuses_is_a_users_mistake():
    with pytest.raises(InputError, match=r"trainer: Lightning refuses it .*max_epochs"), report_refusals([]):
        Trainer(max_epochs=-2, logger=False)
    with pytest.raises(ValueError, match="ours"), report_refusals(["--trainer.max_epochs"]):
        raise ValueError("ours")


def test_weights_that_cannot_be_fetched_are_named_with_their_option(tiny_recipe, offline_timm, capsys):
    """jsonargparse raises a ValueError from the InputError of a system that it builds."""
    with pytest.raises(SystemExit) as exit_:
        main([str(tiny_recipe), "--model.backbone_weights", "timm"])
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: model.backbone_weights: ")
    assert "safetensors" in error
    assert "Lightning" not in error
    assert len(error.strip().splitlines()) == 1


@pytest.mark.slow
def test_run_leaves_everything(trained):
    for name in ("config.yaml", "model.onnx", "validation.png", "checkpoints/best.ckpt", "checkpoints/last.ckpt"):
        assert (trained / name).stat().st_size > 0
    assert list(trained.glob("events.out.tfevents*"))
    metrics = json.loads((trained / "evaluation/best/metrics.json").read_text())
    assert metrics["count"] == 8
    assert metrics["selection"].startswith("best: lowest val/loss on frames held out")
    assert metrics["data"]["scene"] == "heads"
    assert metrics["data"]["official_split"] is False
    clock = metrics["training"]["wall_clock"]
    assert 0 < clock["reached_s"] <= clock["train_s"]
    assert [reading["step"] for reading in clock["history"]] == sorted({r["step"] for r in clock["history"]})
    trained_on = metrics["training"]["data"]
    assert trained_on["train_frames"] < trained_on["listed_frames"]["train"]  # some are held out
    assert len(trained_on["fingerprints"]["train"]) == len(metrics["data"]["fingerprints"]["test"]) == 64
    assert {"commit", "seed", "device", "versions", "recipe_sha256"} <= metrics["training"].keys()


@pytest.mark.slow
def test_predictions_agree_with_metrics(trained):
    folder = trained / "evaluation/last"
    with (folder / "predictions.csv").open() as file:
        rows = list(csv.DictReader(file))
    errors = torch.tensor([float(row["position_error_m"]) for row in rows])
    metrics = json.loads((folder / "metrics.json").read_text())["metrics"]
    assert metrics["position_error_m"] == pytest.approx(errors.quantile(0.5).item(), rel=1e-5)
    tum = [line.split() for line in (folder / "predictions.tum").read_text().splitlines()[1:]]
    for line, row in zip(tum, rows, strict=True):
        expected = [row[f"predicted_{c}"] for c in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
        assert [float(n) for n in line[1:]] == pytest.approx([float(n) for n in expected])


@pytest.mark.slow
def test_saved_config_retrains_the_same(trained, tmp_path):
    words = ["--onnx_export.enabled", "false", "--best_checkpoint.save_top_k", "0"]
    words += ["--trainer.enable_progress_bar", "false"]
    main([str(trained / "config.yaml"), *words, "--trainer.default_root_dir", str(tmp_path / "again")])
    weights = [torch.load(r / "checkpoints/last.ckpt", weights_only=True) for r in (trained, tmp_path / "again")]
    torch.testing.assert_close(weights[0]["state_dict"], weights[1]["state_dict"], rtol=0, atol=0)


@pytest.mark.slow
def test_evaluate_tool_prints_and_writes(trained, tmp_path):
    """In a process of its own, whose stderr is seen whole."""
    words = [trained / "checkpoints/last.ckpt", "--out", tmp_path / "out", "--data.eval_batch_size", "3"]
    command = [sys.executable, REPOSITORY / "tools/evaluate.py", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "last" in done.stdout
    assert "median training pose" in done.stdout
    folder, _, files = done.stdout.splitlines()[-1].partition(": ")
    assert folder == str(tmp_path / "out")
    assert set(files.split(", ")) == {path.name for path in (tmp_path / "out").iterdir()}
    metrics = [
        json.loads((f / "metrics.json").read_text())["metrics"] for f in (tmp_path / "out", trained / "evaluation/last")
    ]
    assert metrics[0] == pytest.approx(metrics[1], rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["missing.ckpt"], "missing.ckpt"),
        (["CHECKPOINT", "--data.image_size", "16"], "trained on (32, 32)"),
        (["CHECKPOINT", "--data.root", "nowhere"], "nowhere"),
        (["CHECKPOINT", "--accelerator", "abacus"], "--accelerator abacus: You selected an invalid accelerator"),
        (["pyproject.toml"], "pyproject.toml"),
    ],
)
def test_evaluate_tool_used_wrong(words, rule, trained, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(REPOSITORY)
    words = [trained / "checkpoints/last.ckpt" if word == "CHECKPOINT" else word for word in words]
    with pytest.raises(SystemExit) as exit_:
        tool("evaluate", *words, "--out", tmp_path / "out")
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert rule in error
    assert len(error.strip().splitlines()) == 1


@pytest.mark.slow
def test_loaded_system_localizes(trained):
    system = mambaloc.load(trained / "checkpoints/best.ckpt")
    assert isinstance(system, mambaloc.LitMambaLoc)
    with torch.inference_mode():
        prediction = system(torch.rand(2, 3, 32, 32))
    assert prediction.position_m.shape == (2, 3)
    assert system.provenance["seed"] == 0


@pytest.mark.slow
def test_selection_rule_is_written_into_the_result(trained_student, tiny_recipe, tmp_path):
    """Without validation, and where the test frames are what is validated on."""
    words = ["--data.validation", "test_set", "--trainer.max_epochs", "1", "--trainer.default_root_dir", str(tmp_path)]
    main([str(tiny_recipe), *words])
    unvalidated, on_test = (
        [json.loads(path.read_text())["selection"] for path in sorted(run.glob("evaluation/*/metrics.json"))]
        for run in (trained_student, tmp_path)
    )
    assert unvalidated == ["last"]
    assert "ON THE TEST SET" in on_test[0]
