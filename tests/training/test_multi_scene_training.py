"""One network for two rendered scenes, from the recipe to the bundle."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from tiny import TINY_BACKBONE, write_recipe

from mambaloc.cli import main
from mambaloc.commands import evaluate, visualize
from mambaloc.export import write_bundle
from mambaloc.images import read_image
from mambaloc.models import Checkpoint
from mambaloc.runtime import Localizer
from mambaloc.runtime.bundle import verify_bundle

TRAIN = (sys.executable, Path(__file__).parents[2] / "tools/train.py")
SCENES = ["heads", "lab"]
MODEL = {
    "class_path": "LitDenseLoc",
    "init_args": {
        "backbone": TINY_BACKBONE, "dim": 16, "heads": 2, "encoder_layers": 1, "feedforward": 16, "lr": 0.003,
        "normalise_position": True,
    },
}  # fmt: skip
OFFSET_M = (500_000.0, 4_000_000.0, 30.0)


@pytest.fixture(scope="session")
def two_scenes(made_once, scenes):
    """A root with ``heads``, and ``lab``: another room, whose frame lies far from its world's origin."""
    from mambaloc.rendering.scenes.layouts import write_7scenes
    from mambaloc.rendering.scenes.shots import frames_of_sequences
    from mambaloc.rendering.trajectories import smooth_trajectory

    def render(root: Path) -> None:
        shutil.copytree(scenes / "heads", root / "heads")
        inside_m = ((-2.0, -2.0, 1.2), (2.0, 2.0, 1.6))
        sequences = {n: smooth_trajectory(6 if n == 3 else 12, seed=n + 10, inside_m=inside_m) for n in (1, 2, 3)}
        lab = write_7scenes(root, "lab", frames_of_sequences(sequences, {3}), size=(96, 72), seed=5)
        note = json.loads((lab / "scene.json").read_text())
        (lab / "scene.json").write_text(json.dumps({**note, "world": {"offset_m": OFFSET_M, "metres_per_unit": 1.0}}))

    return made_once("two_scenes", render)


@pytest.fixture(scope="session")
def run(made_once, two_scenes):
    """The folder of a run of 30 epochs on both scenes."""

    def train(folder: Path) -> None:
        data = {"scenes": SCENES, "batch_size": 8, "validation": "block", "val_gap": 1, "val_fraction": 0.4}
        data |= {"brightness": 0.0, "contrast": 0.0, "saturation": 0.0}  # colours tell the two rooms apart
        recipe = write_recipe(folder / "recipe.yaml", two_scenes, MODEL, data, max_epochs=30)
        main([str(recipe), "--onnx_export.enabled", "true", "--trainer.default_root_dir", str(folder / "run")])

    return made_once("run_of_two_scenes", train) / "run"


def read(path):
    return json.loads(path.read_text())


def test_each_scene_is_measured_by_itself(run):
    results = {name: read(run / f"evaluation/best/{name}/metrics.json") for name in SCENES}
    assert np.mean([each["recognised"] for each in results.values()]) > 0.6  # half are by chance
    for name, result in results.items():
        assert result["data"]["scene"] == name
        assert result["count"] == {"heads": 8, "lab": 6}[name]
        assert result["training"]["data"]["scenes"].keys() == set(SCENES)
        assert (run / f"evaluation/best/{name}/trajectory.png").is_file()


def test_evaluate_measures_a_checkpoint_again(run, tmp_path, capsys):
    evaluate.main([str(run / "checkpoints/best.ckpt"), "--out", str(tmp_path)])
    for name in SCENES:
        again, first = (read(folder / name / "metrics.json") for folder in (tmp_path, run / "evaluation/best"))
        for metric, value in first["metrics"].items():  # null where a frame was taken for another scene's
            assert again["metrics"][metric] == (None if value is None else pytest.approx(value, rel=1e-5))
    assert "mean of scenes" in capsys.readouterr().out


def test_the_exported_model_says_the_scene_and_the_pose_in_its_world(run, two_scenes):
    """Oracle: the predictions that the evaluation wrote, which are in the worlds, too."""
    localizer = Localizer(run / "model.onnx")
    assert [scene.name for scene in localizer.contract.scenes] == SCENES
    for name in SCENES:
        with (run / f"evaluation/best/{name}/predictions.csv").open() as file:
            rows = list(csv.DictReader(file))
        said = [localizer.localize(read_image(two_scenes / name / row["image"])) for row in rows]
        assert (
            np.mean([each.scene == name for each in said])
            == read(run / f"evaluation/best/{name}/metrics.json")["recognised"]
        )
        assert all(0.5 <= each.scene_probability <= 1 for each in said)
        for each, row in zip(said, rows, strict=True):
            if each.scene != name:
                continue
            expected = [float(row[f"predicted_{axis}_m"]) for axis in ("x", "y", "z")]
            np.testing.assert_allclose(each.position_m, expected, atol=1e-3)


def test_its_radii_are_of_frames_of_both_scenes(run):
    contract = Localizer(run / "model.onnx").contract
    told = Checkpoint.read(run / "checkpoints/best.ckpt").provenance["data"]["scenes"]
    held_out = sum(each["val_frames"] for each in told.values())
    assert 0 < contract.uncertainty["held_out_frames"] <= held_out


def test_a_bundle_has_pictures_of_each_scene(run, tmp_path):
    checkpoint = Checkpoint.read(run / "checkpoints/best.ckpt")
    written = write_bundle(checkpoint.system(), checkpoint.data(), tmp_path / "bundle", ("onnx", "fp16"), "web")
    assert all(each.within for each in written.deviations)
    assert all(each.within for each in verify_bundle(tmp_path / "bundle"))
    contract = read(tmp_path / "bundle/contract.json")
    assert [each["name"] for each in contract["scenes"]] == SCENES
    assert contract["scenes"][1]["world"]["offset_m"] == list(OFFSET_M)
    assert contract["outputs"]["scene_probability"] == ["batch", 2]


@pytest.mark.parametrize(
    ("command", "options", "message"),
    [
        (evaluate.main, ["--map", "map.safetensors"], "is of one scene, and this network knows several"),
        (lambda words: visualize.main(["trajectory", *words]), [], "has several scenes"),
    ],
)
def test_what_takes_one_scene_says_so(run, command, options, message, capsys):
    with pytest.raises(SystemExit) as error:
        command([str(run / "checkpoints/best.ckpt"), *options])
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
def test_a_recipe_that_cannot_be_is_refused(run, options, message, tmp_path, capsys):
    recipe = run.parent / "recipe.yaml"
    with pytest.raises(SystemExit) as error:
        main([str(recipe), *options, "--trainer.default_root_dir", str(tmp_path)])
    assert error.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_two_processes_are_one_training_of_both_scenes(run, tmp_path):
    """Half a minute: two processes import torch and train, as two machines would."""
    said = yaml.safe_load((run.parent / "recipe.yaml").read_text())
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
