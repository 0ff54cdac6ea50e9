"""Every shipped recipe runs fit, validate, test and predict, on rendered scenes."""

from pathlib import Path

import lightning as L
import pytest
import yaml

from mambaloc.cli import main
from mambaloc.models import create_model
from mambaloc.rendering.scenes.layouts import write_cambridge
from mambaloc.rendering.scenes.shots import FRAME_CAMBRIDGE, shots_of_sequences
from mambaloc.rendering.trajectories import smooth_trajectory

REPOSITORY = Path(__file__).parents[2]

RECIPES = sorted((REPOSITORY / "recipes").glob("*.yaml"))
BLOCKS = REPOSITORY / "recipes/overlays/redkitchen_blocks.yaml"
OVERLAYS = sorted({*BLOCKS.parent.glob("*.yaml")} - {BLOCKS, BLOCKS.with_name("gpu.yaml")})  # see test_gpu.py


@pytest.fixture(scope="session")
def cambridge(tmp_path_factory):
    root = tmp_path_factory.mktemp("cambridge")
    inside_m = ((-4.0, -4.0, 1.5), (4.0, 4.0, 2.5))
    sequences = {n: smooth_trajectory(6, seed=n, inside_m=inside_m) for n in (1, 2, 3)}
    write_cambridge(
        root, "KingsCollege", shots_of_sequences(sequences, {3}, FRAME_CAMBRIDGE), size=(96, 54), points=True
    )
    return root


@pytest.fixture(scope="session")
def teacher(tmp_path_factory):
    path = tmp_path_factory.mktemp("teacher") / "best.ckpt"
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.strategy.connect(
        create_model("mambaloc", image_size=48, encoder_layers=1, backbone="mobilenetv3_small_050")
    )
    trainer.save_checkpoint(path)
    return path


def stand_in(recipe: Path, scenes: Path, cambridge: Path, teacher: Path) -> list[str]:
    """Options that put a small rendered scene in the place of data and weights that are not there."""
    data, model = (yaml.safe_load(recipe.read_text())[section] for section in ("data", "model"))
    options = ["--model.backbone_weights", "null", "--model.warm_start", "null", "--trainer.accelerator", "cpu"]
    options += ["--model.teacher", str(teacher)] if "teacher" in model["init_args"] else []
    options += ["--data.image_size", "48", "--data.short_side", "48"]
    if data["dataset"] == "cambridge":
        return [*options, "--data.root", str(cambridge), "--data.scene", "KingsCollege"]
    return [*options, "--data.dataset", "7scenes", "--data.root", str(scenes), "--data.scene", "heads"]


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES, ids=lambda path: path.stem)
def test_recipe_runs(recipe, scenes, cambridge, teacher, tmp_path):
    options = [*stand_in(recipe, scenes, cambridge, teacher), "--trainer.fast_dev_run", "1", "--data.batch_size", "2"]
    options += ["--data.validation", "sequences", "--data.val_sequences", "null"]
    for subcommand in ("fit", "validate", "test", "predict"):
        cli = main([subcommand, str(recipe), *options, "--trainer.default_root_dir", str(tmp_path)])
        assert cli.trainer.state.finished


@pytest.mark.slow
@pytest.mark.parametrize("overlay", OVERLAYS, ids=lambda path: path.stem)
def test_overlay_changes_what_it_says(overlay, tiny_recipe, tmp_path):
    def run(*recipes):
        cli = main([*map(str, recipes), "--trainer.fast_dev_run", "1", "--retrieval", "false"])
        return {"model": cli.model.hparams, "data": cli.datamodule.hparams}

    base = [tiny_recipe, overlay.with_name("gis_none.yaml")] if overlay.stem == "gis" else [tiny_recipe]
    plain, changed = run(*base), run(*base, overlay)
    for section, values in yaml.safe_load(overlay.read_text()).items():
        if section in plain:
            values = values.get("init_args") or values
            assert {key: changed[section][key] for key in values} == values
            assert changed[section] != plain[section]


@pytest.mark.slow
@pytest.mark.parametrize("recipe", [r for r in RECIPES if r.stem.endswith("_7scenes")], ids=lambda path: path.stem)
def test_every_system_takes_the_equal_budget(recipe, scenes, cambridge, teacher, tmp_path):
    options = [*stand_in(recipe, scenes, cambridge, teacher), "--trainer.default_root_dir", str(tmp_path)]
    cli = main([str(recipe), str(BLOCKS), *options, "--trainer.fast_dev_run", "1", "--data.batch_size", "2"])
    assert cli.model.hparams["backbone"] == "mobilenetv2_100"
    assert cli.trainer.state.finished
