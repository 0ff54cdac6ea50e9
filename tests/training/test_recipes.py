"""Every shipped recipe fits, validates, tests and predicts on rendered scenes, with a tiny network in place of its own.

The networks' own sizes are pinned in tests/benchmark, and one of them is trained here.
"""

import functools
import inspect
from pathlib import Path

import lightning as L
import pytest
import timm
import yaml

from mambaloc.cli import RecipeCLI, main
from mambaloc.distillation import LitDistillation
from mambaloc.models import LitPoseRegressor, create_model, list_models
from mambaloc.models.registry import model_class
from mambaloc.rendering.scenes.layouts import write_cambridge
from mambaloc.rendering.scenes.shots import FRAME_CAMBRIDGE, frames_of_sequences
from mambaloc.rendering.trajectories import smooth_trajectory

REPOSITORY = Path(__file__).parents[2]

RECIPES = sorted({*(REPOSITORY / "recipes").glob("*.yaml")} - {*(REPOSITORY / "recipes").glob("map_*.yaml")})
BLOCKS = REPOSITORY / "recipes/overlays/redkitchen_blocks.yaml"
OTHERS = {BLOCKS, *(BLOCKS.with_name(f"{name}.yaml") for name in ("gpu", "mlflow", "wandb"))}  # test_gpu, test_trackers
OVERLAYS = sorted({*BLOCKS.parent.glob("*.yaml")} - OTHERS)

SYSTEMS = {system.__name__: system for system in (LitDistillation, *map(model_class, list_models()))}
NARROW = {
    "dim": 16, "encoder_layers": 1, "decoder_layers": 1, "heads": 2, "feedforward": 16, "head_hidden": 16, "width": 64,
    "hidden": 16, "stage_channels": 64, "blocks": 2, "groups": 4,
}  # fmt: skip


@pytest.fixture(scope="session")
def cambridge(shared_folder):
    def render(root: Path) -> None:
        inside_m = ((-4.0, -4.0, 1.5), (4.0, 4.0, 2.5))
        sequences = {n: smooth_trajectory(6, seed=n, inside_m=inside_m) for n in (1, 2, 3)}
        shots = frames_of_sequences(sequences, {3}, FRAME_CAMBRIDGE)
        write_cambridge(root, "KingsCollege", shots, size=(96, 54), points=True)

    return shared_folder("cambridge", render)


@pytest.fixture(scope="session")
def teacher(shared_folder):
    def save(folder: Path) -> None:
        trainer = L.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
        trainer.strategy.connect(
            create_model("mambaloc", image_size=48, encoder_layers=1, backbone="test_efficientnet")
        )
        trainer.save_checkpoint(folder / "best.ckpt")

    return shared_folder("teacher_of_recipes", save) / "best.ckpt"


@pytest.fixture
def tiny_backbones(monkeypatch):
    """A tiny network whichever of its own timm is asked for."""
    create = timm.create_model

    def create_tiny(name, **kwargs):
        assert timm.is_model(name)
        return create("test_efficientnet", **kwargs)

    monkeypatch.setattr(timm, "create_model", create_tiny)


def stand_in(recipe: Path, scenes: Path, cambridge: Path, teacher: Path) -> list[str]:
    """Options that put a small rendered scene in the place of data and weights that are not there."""
    data, model = (yaml.safe_load(recipe.read_text())[section] for section in ("data", "model"))
    options = ["--model.backbone_weights", "null", "--model.warm_start", "null", "--trainer.accelerator", "cpu"]
    options += ["--model.teacher", str(teacher)] if "teacher" in model["init_args"] else []
    options += ["--data.image_size", "48", "--data.short_side", "48", "--data.batch_size", "2"]
    options += ["--data.validation", "sequences", "--data.val_sequences", "null", "--trainer.fast_dev_run", "1"]
    dataset, root, scene = ("7scenes", scenes, "heads")
    if data["dataset"] == "cambridge":
        dataset, root, scene = ("cambridge", cambridge, "KingsCollege")
    place = ["--data.dataset", dataset, "--data.root", str(root)]
    if "scenes" in data:  # the same one, by its name and by its path
        return [*options, *place, "--data.scenes", f"[{scene},{root / scene}]"]
    return [*options, *place, "--data.scene", scene]


def narrow(recipe: Path) -> list[str]:
    """Options that make the recipe's system narrow and shallow, as far as it has such."""
    system = SYSTEMS[yaml.safe_load(recipe.read_text())["model"]["class_path"]]
    bases = [base for base in system.__mro__ if issubclass(base, LitPoseRegressor)]
    taken = {parameter for base in bases for parameter in inspect.signature(base).parameters}
    return [word for key, value in NARROW.items() if key in taken for word in (f"--model.{key}", str(value))]


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES, ids=lambda path: path.stem)
def test_recipe_runs(recipe, scenes, cambridge, teacher, tiny_backbones, tmp_path):
    options = [*stand_in(recipe, scenes, cambridge, teacher), *narrow(recipe)]
    cli = main([str(recipe), *options, "--trainer.default_root_dir", str(tmp_path)])
    assert cli.trainer.state.finished
    for verb in (cli.trainer.validate, cli.trainer.test, cli.trainer.predict):
        verb(cli.model, datamodule=cli.datamodule)
        assert cli.trainer.state.finished


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["validate", "test", "predict"])
def test_a_recipe_runs_without_training(verb, tiny_recipe, tmp_path):
    cli = main([verb, str(tiny_recipe), "--trainer.default_root_dir", str(tmp_path), "--trainer.fast_dev_run", "1"])
    assert cli.trainer.state.finished


@pytest.mark.slow
def test_the_papers_system_trains_at_its_own_size(scenes, cambridge, teacher, tmp_path):
    recipe = REPOSITORY / "recipes/mambaloc_7scenes.yaml"
    cli = main([str(recipe), *stand_in(recipe, scenes, cambridge, teacher)])
    assert cli.trainer.state.finished
    assert cli.model.hparams["backbone"] == "efficientnet_b0"
    assert cli.model.hparams["encoder_layers"] == 6


@functools.cache
def parsed(*recipes: Path) -> dict:
    """What recipes come to, once a trainer, a system and a data module were built from them; nothing is trained."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RecipeCLI, "fit", lambda self, model, **kwargs: None)
        config = main([*map(str, recipes), "--trainer.fast_dev_run", "1", "--retrieval", "false"]).config["fit"]
    return {**config.as_dict(), "model": config.model.init_args.as_dict()}


@pytest.mark.slow
@pytest.mark.parametrize("overlay", OVERLAYS, ids=lambda path: path.stem)
def test_overlay_changes_what_it_says(overlay, trained):
    recipe = trained.parent / "recipe.yaml"
    base = [recipe, overlay.with_name("gis_none.yaml")] if overlay.stem == "gis" else [recipe]
    plain, changed = parsed(*base), parsed(*base, overlay)
    for section, values in yaml.safe_load(overlay.read_text()).items():
        if isinstance(values, dict):
            values = values.get("init_args") or values
            values = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
            assert {key: changed[section][key] for key in values} == values
            assert changed[section] != plain[section] or section == "onnx_export"  # that is off in either


@pytest.mark.slow
@pytest.mark.nightly
def test_compiled_overlay_trains(tiny_recipe):
    """Compiling takes a minute. The gate has the overlay's parsed values above, and test_engine.py's refusals."""
    cli = main([str(tiny_recipe), str(BLOCKS.with_name("compiled.yaml")), "--trainer.fast_dev_run", "1"])
    assert cli.trainer.state.finished


@pytest.mark.slow
@pytest.mark.parametrize("recipe", [r for r in RECIPES if r.stem.endswith("_7scenes")], ids=lambda path: path.stem)
def test_every_system_takes_the_equal_budget(recipe, scenes, cambridge, teacher, tmp_path):
    options = [*stand_in(recipe, scenes, cambridge, teacher), *narrow(recipe)]
    cli = main([str(recipe), str(BLOCKS), *options, "--trainer.default_root_dir", str(tmp_path)])
    assert cli.model.hparams["backbone"] == "mobilenetv2_100"
    assert cli.trainer.state.finished
