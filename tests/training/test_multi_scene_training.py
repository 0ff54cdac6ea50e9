"""One network for two rendered scenes, from the recipe to the bundle."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import event_loop
import numpy as np
import pytest
import yaml
from tiny import LAB_OFFSET_M, TWO_SCENES

from mambaloc.cli import main
from mambaloc.commands import evaluate, localize, visualize
from mambaloc.images import read_image
from mambaloc.models import Checkpoint
from mambaloc.runtime import Localizer
from mambaloc.runtime.bundle import verify_bundle
from mambaloc.serving.workers import Task, Workers

TRAIN = (sys.executable, Path(__file__).parents[2] / "tools/train.py")


def read(path):
    return json.loads(path.read_text())


def test_each_scene_is_measured_by_itself(trained_on_two):
    results = {name: read(trained_on_two / f"evaluation/best/{name}/metrics.json") for name in TWO_SCENES}
    assert np.mean([each["recognised"] for each in results.values()]) > 0.6  # half are by chance
    for name, result in results.items():
        assert result["data"]["scene"] == name
        assert result["count"] == {"heads": 8, "lab": 6}[name]
        assert result["training"]["data"]["scenes"].keys() == set(TWO_SCENES)
        assert (trained_on_two / f"evaluation/best/{name}/trajectory.png").is_file()


def test_evaluate_measures_a_checkpoint_again(trained_on_two, tmp_path, capsys):
    evaluate.main([str(trained_on_two / "checkpoints/best.ckpt"), "--out", str(tmp_path)])
    for name in TWO_SCENES:
        again, first = (
            read(folder / name / "metrics.json") for folder in (tmp_path, trained_on_two / "evaluation/best")
        )
        for metric, value in first["metrics"].items():  # null where a frame was taken for another scene's
            assert again["metrics"][metric] == (None if value is None else pytest.approx(value, rel=1e-5))
    assert "mean of scenes" in capsys.readouterr().out


def test_the_exported_model_says_the_scene_and_the_pose_in_its_world(trained_on_two, heads_and_lab):
    """Oracle: the predictions that the evaluation wrote, which are in the worlds, too."""
    localizer = Localizer(trained_on_two / "model.onnx")
    assert [scene.name for scene in localizer.contract.scenes] == TWO_SCENES
    for name in TWO_SCENES:
        with (trained_on_two / f"evaluation/best/{name}/predictions.csv").open() as file:
            rows = list(csv.DictReader(file))
        said = [localizer.localize(read_image(heads_and_lab / name / row["image"])) for row in rows]
        assert (
            np.mean([each.scene == name for each in said])
            == read(trained_on_two / f"evaluation/best/{name}/metrics.json")["recognised"]
        )
        assert all(0.5 <= each.scene_probability <= 1 for each in said)
        for each, row in zip(said, rows, strict=True):
            if each.scene != name:
                continue
            expected = [float(row[f"predicted_{axis}_m"]) for axis in ("x", "y", "z")]
            np.testing.assert_allclose(each.position_m, expected, atol=1e-3)


def test_its_radii_are_of_frames_of_both_scenes(trained_on_two):
    contract = Localizer(trained_on_two / "model.onnx").contract
    told = Checkpoint.read(trained_on_two / "checkpoints/best.ckpt").provenance["data"]["scenes"]
    held_out = sum(each["val_frames"] for each in told.values())
    assert 0 < contract.uncertainty["held_out_frames"] <= held_out


def test_a_bundle_has_pictures_of_each_scene(bundle_of_two):
    assert all(each.within for each in verify_bundle(bundle_of_two))
    contract = read(bundle_of_two / "contract.json")
    assert [each["name"] for each in contract["scenes"]] == TWO_SCENES
    assert contract["scenes"][1]["world"]["offset_m"] == list(LAB_OFFSET_M)
    assert contract["outputs"]["scene_probability"] == ["batch", 2]


def test_each_recognized_scene_has_a_trajectory_of_its_own(bundle_of_two, tmp_path, capsys, monkeypatch):
    """Oracle: the localizer, asked frame by frame."""
    frames = bundle_of_two / "frames"
    expected = [pose for _, pose in Localizer(bundle_of_two).localize_each(frames)]
    words = ["localize", str(bundle_of_two), str(frames), "--out", str(tmp_path / "poses.tum")]
    monkeypatch.setattr(sys, "argv", words)
    localize.main()
    printed = capsys.readouterr().out
    named = {pose.scene for pose in expected}
    assert {path.name for path in tmp_path.iterdir()} == {f"poses_{scene}.tum" for scene in named}
    for scene in named:
        poses_m = [pose.position_m for pose in expected if pose.scene == scene]
        written = np.loadtxt(tmp_path / f"poses_{scene}.tum", ndmin=2)
        np.testing.assert_allclose(written[:, 1:4], poses_m, rtol=1e-8, atol=1e-6)
        assert f"{scene} ({len(poses_m)})" in printed


def test_the_service_says_the_scene_of_each_image(bundle_of_two):
    frames = sorted((bundle_of_two / "frames").glob("*.png"))

    async def localize():
        workers = Workers({"both": bundle_of_two}, 1)
        await workers.start()
        try:
            return [await workers.localize(Task("both", frame.read_bytes())) for frame in frames]
        finally:
            workers.stop()

    for frame, answer in zip(frames, event_loop.run(localize()), strict=True):
        expected = Localizer(bundle_of_two, threads=1).localize(frame)
        assert answer["scene"] == expected.scene
        assert answer["scene_probability"] == pytest.approx(expected.scene_probability, abs=1e-4)


@pytest.mark.parametrize(
    ("command", "options", "message"),
    [
        (evaluate.main, ["--map", "map.safetensors"], "is of one scene, and this network knows several"),
        (lambda words: visualize.main(["trajectory", *words]), [], "has several scenes"),
    ],
)
def test_what_takes_one_scene_says_so(trained_on_two, command, options, message, capsys):
    with pytest.raises(SystemExit) as error:
        command([str(trained_on_two / "checkpoints/best.ckpt"), *options])
    assert error.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--map.enabled", "true"], "a map is of one scene"),
        (["--data.scenes", "[heads]"], "two scenes or more"),
        (["--data.scenes", "[heads,nowhere]"], "nowhere"),
        (["--data.batch_size", "1"], "no image for some"),
    ],
)
def test_a_recipe_that_cannot_be_is_refused(trained_on_two, options, message, tmp_path, capsys):
    recipe = trained_on_two.parent / "recipe.yaml"
    with pytest.raises(SystemExit) as error:
        main([str(recipe), *options, "--trainer.default_root_dir", str(tmp_path)])
    assert error.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_two_processes_are_one_training_of_both_scenes(trained_on_two, tmp_path):
    """Half a minute: two processes import torch and train, as two machines would."""
    said = yaml.safe_load((trained_on_two.parent / "recipe.yaml").read_text())
    said["trainer"] |= {"strategy": "ddp", "max_epochs": 1}
    said["data"] |= {"eval_batch_size": 1, "batch_size": 2}
    recipe = tmp_path / "distributed.yaml"
    recipe.write_text(yaml.safe_dump(said))
    words = [*TRAIN, recipe, "--trainer.devices", "2", "--trainer.default_root_dir", tmp_path / "run"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stderr
    (log,) = (tmp_path / "run/metrics").glob("version_*/metrics.csv")
    names = ("val/loss", "val/position_error_m", "val/rotation_error_deg")
    with log.open() as file:
        logged = {name: float(row[name]) for row in csv.DictReader(file) for name in names if row[name]}
    words = ["validate", str(recipe), "--ckpt_path", str(tmp_path / "run/checkpoints/last.ckpt")]
    metrics = main([*words, "--trainer.strategy", "auto", "--trainer.logger", "false"]).trainer.callback_metrics
    assert logged == pytest.approx({name: metrics[name].item() for name in names}, rel=1e-6)
