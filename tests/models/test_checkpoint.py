"""What a checkpoint says, of a real, tiny training; ``test_registry.py`` has the files that are refused."""

import hashlib
from dataclasses import replace

import pytest
import torch
import yaml

from mambaloc.errors import InputError
from mambaloc.evaluation.evaluate import _first_backbone
from mambaloc.models import Checkpoint, LitPoseRegressor
from mambaloc.models.mambaloc import LitMambaLoc
from mambaloc.models.weights import build_from

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def best(trained):
    return Checkpoint.read(trained / "checkpoints/best.ckpt")


def test_the_system_is_the_one_that_was_trained(best):
    system = best.system()
    assert type(system) is LitMambaLoc
    assert not system.training
    assert all(torch.equal(value, best.stored["state_dict"][name]) for name, value in system.state_dict().items())
    assert system.provenance == best.provenance
    assert {"model": "mambaloc", "seed": 0}.items() <= best.provenance.items()
    again, public = best.system(), LitMambaLoc.load_from_checkpoint(best.path).eval()
    image = torch.rand(2, 3, 32, 32)
    with torch.inference_mode():
        positions = [each(image).position_m for each in (system, again, public)]
    assert torch.equal(positions[0], positions[1])
    assert torch.equal(positions[0], positions[2])


def test_weights_left_over_are_an_error_unless_asked_otherwise(best, tmp_path):
    stored = torch.load(best.path, weights_only=True)
    stored["state_dict"]["network.extra"] = torch.zeros(1)
    torch.save(stored, tmp_path / "more.ckpt")
    with pytest.raises(RuntimeError, match=r"Unexpected key.*network\.extra"):
        LitMambaLoc.load_from_checkpoint(tmp_path / "more.ckpt")
    assert LitMambaLoc.load_from_checkpoint(tmp_path / "more.ckpt", strict=False).provenance["model"] == "mambaloc"


def test_hyperparameters_given_to_load_from_checkpoint_replace_the_stored(best):
    assert LitMambaLoc.load_from_checkpoint(str(best.path), map_location="cpu", lr=0.5).lr == 0.5
    assert best.system().lr == 0.001


def test_the_data_is_that_of_the_recipe(best, trained):
    recipe = yaml.safe_load((trained / "config.yaml").read_text())["data"]
    assert (recipe.pop("scenes"), recipe.pop("scene_share")) == (None, "equal")  # it is of one scene
    assert {name: best.data().hparams[name] for name in recipe} == recipe
    assert best.data(root="/elsewhere").hparams["root"] == "/elsewhere"
    without = replace(best, stored={**best.stored, "datamodule_hyper_parameters": {}})
    with pytest.raises(InputError, match=r"best\.ckpt: contains no data settings"):
        without.data()


def test_arguments_of_earlier_versions_do_not_matter_where_they_only_augmented(best):
    stored = best.stored["datamodule_hyper_parameters"]
    older = replace(best, stored={**best.stored, "datamodule_hyper_parameters": {**stored, "focal_ratio": 0.914}})
    assert dict(older.data().hparams) == dict(best.data().hparams)
    unknown = replace(best, stored={**best.stored, "datamodule_hyper_parameters": {**stored, "zoo": 1}})
    with pytest.raises(TypeError, match="zoo"):
        unknown.data()


def test_how_the_epoch_was_chosen(best, trained):
    assert best.selection == "best: lowest val/loss on frames held out of training"
    assert Checkpoint.read(trained / "checkpoints/last.ckpt").selection == "last"
    on_test = {**best.stored, "datamodule_hyper_parameters": {"validation": "test_set"}}
    assert replace(best, stored=on_test).selection.startswith("best on TEST: lowest val/loss ON THE TEST SET, so")
    assert replace(best, stored={**best.stored, "callbacks": {}}).selection == "last"


def test_the_training_is_described(best, trained):
    description = best.describe()
    assert description["epoch"] == best.stored["epoch"] + 1
    assert description["checkpoint_sha256"] == hashlib.sha256(best.path.read_bytes()).hexdigest()
    assert description["recipe_sha256"] == hashlib.sha256((trained / "config.yaml").read_bytes()).hexdigest()
    assert description["wall_clock"]["train_s"] > 0
    assert len(description["wall_clock"]["history"]) == description["epoch"]
    assert replace(best, stored={**best.stored, "callbacks": {}}).wall_clock is None


def test_the_backbone_that_a_training_started_from(best):
    started = {**best.stored["hyper_parameters"], "backbone_weights": "timm", "pixel_mean": [0.5, 0.5, 0.5]}
    arguments = replace(best, stored={**best.stored, "hyper_parameters": started}).backbone_arguments
    assert arguments == {
        "name": "test_efficientnet", "weights": "timm", "timm_args": None, "pixel_mean": [0.5, 0.5, 0.5],
        "pixel_std": None,
    }  # fmt: skip


def test_a_system_without_arguments_of_a_backbone(best):
    """Evaluating it with --retrieval ends in one line, as for a backbone that started from scratch."""
    fixed = replace(best, stored={**best.stored, "hyper_parameters": {"lr": 0.001}})
    assert set(fixed.backbone_arguments.values()) == {None}
    with pytest.raises(InputError, match="--retrieval: needs a backbone that started from pretrained weights"):
        _first_backbone(fixed)


def test_what_only_a_resumed_training_needs_is_not_kept(best):
    assert "optimizer_states" not in best.stored
    assert torch.load(best.path, weights_only=True)["optimizer_states"]


def test_a_class_without_further_arguments_is_built_from_those_it_has(best):
    class LitFixed(LitPoseRegressor):
        def __init__(self, lr: float) -> None:
            super().__init__(image_size=32, lr=lr)

        def configure_network(self):
            return system.network

    system = best.system()
    assert build_from(best.stored, LitFixed).lr == 0.001
