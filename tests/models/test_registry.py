import pickle

import lightning as L
import pytest
import torch
from torch import Tensor, nn

import mambaloc
from mambaloc.errors import InputError
from mambaloc.models import Checkpoint, LitPoseRegressor, create_model, list_models, register_model, registry
from mambaloc.models.mambaloc import LitMambaLoc
from mambaloc.models.weights import start_from
from mambaloc.types import PosePrediction


class Mean(nn.Module):
    """The smallest localizer: a linear map of the mean colour."""

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__()
        self.linear, self.gain = nn.Linear(3, 7), gain

    def forward(self, image: Tensor) -> PosePrediction:
        output = self.gain * self.linear(image.mean((-2, -1)))
        return PosePrediction(output[:, :3], output[:, 3:])


class LitMean(LitPoseRegressor):
    def __init__(self, gain: float = 1.0, **training) -> None:
        super().__init__(**training)

    def configure_network(self) -> Mean:
        return Mean(**self.hyperparameters_of(Mean))


@pytest.fixture(autouse=True)
def own_registry(monkeypatch):
    """What a test registers is gone after it."""
    monkeypatch.setattr(registry, "_MODELS", dict(registry._MODELS))


def save(system: LitPoseRegressor, path) -> None:
    trainer = L.Trainer(default_root_dir=path.parent, accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.strategy.connect(system)
    trainer.save_checkpoint(path)


# --- names -----------------------------------------------------------------------------------------------------------


def test_models_are_listed_in_order_and_by_wildcard():
    for name in ("zebra", "mean_small", "mean_large"):
        register_model(name)(type("LitOther", (LitMean,), {}))
    assert list_models() == sorted(list_models())
    assert {"mambaloc", "zebra"} <= set(list_models())
    assert list_models("mean_*") == ["mean_large", "mean_small"]
    assert list_models("nothing*") == []


def test_a_registered_model_is_created_with_its_arguments():
    register_model("mean")(LitMean)
    system = create_model("mean", gain=3.0, lr=0.5, image_size=(8, 10))
    assert type(system) is LitMean
    assert LitMean.registry_name == "mean"
    assert (system.network.gain, system.lr, system.image_size) == (3.0, 0.5, (8, 10))


@pytest.mark.parametrize("name", ["mamba_loc", "MambaLoc", "mambalok"])
def test_a_near_miss_is_answered_with_the_name(name):
    with pytest.raises(InputError, match="Did you mean mambaloc") as error:
        create_model(name)
    assert "\n" not in str(error.value)


def test_a_far_miss_is_answered_with_all_names():
    with pytest.raises(InputError, match="zzz") as error:
        create_model("zzz")
    assert all(name in str(error.value) for name in list_models())


def test_a_name_is_taken_once():
    register_model("mean")(LitMean)
    with pytest.raises(ValueError, match="'mean' is registered already, by LitMean"):
        register_model("mean")(type("LitOther", (LitMean,), {}))
    assert type(create_model("mean")) is LitMean


def test_a_notebooks_cell_may_run_twice():
    register_model("mean")(LitMean)
    again = type("LitMean", (LitMean,), {"__module__": LitMean.__module__, "__qualname__": LitMean.__qualname__})
    with pytest.warns(UserWarning, match="'mean' is registered again. The new LitMean replaces it") as caught:
        register_model("mean")(again)
    assert caught[0].filename == __file__, "the warning names the cell"
    assert type(create_model("mean")) is again


def test_a_system_without_a_network_is_named():
    with pytest.raises(TypeError, match="LitEmpty"):
        type("LitEmpty", (LitPoseRegressor,), {})()


def test_the_package_offers_the_registry():
    assert mambaloc.list_models("*loc*") == list_models("*loc*")
    assert mambaloc.LitMambaLoc is LitMambaLoc
    with pytest.raises(AttributeError, match="no_such_thing"):
        mambaloc.no_such_thing


# --- loading ---------------------------------------------------------------------------------------------------------


def test_load_finds_the_class_of_a_checkpoint(tmp_path):
    register_model("mean")(LitMean)
    small = {"backbone": "mobilenetv3_small_050", "encoder_layers": 1, "dim": 16, "heads": 2, "image_size": 32}
    for name, kwargs in {"mean": {"gain": 2.0, "lr": 0.5}, "mambaloc": small}.items():
        system = create_model(name, **kwargs)
        save(system, tmp_path / f"{name}.ckpt")
        loaded = Checkpoint.read(tmp_path / f"{name}.ckpt").system()
        assert type(loaded) is type(system)
        assert not loaded.training
        assert {k: loaded.hparams[k] for k in kwargs} == kwargs
        assert all(torch.equal(v, loaded.state_dict()[k]) for k, v in system.state_dict().items())
        assert loaded.provenance["model"] == name
        assert {"commit", "versions", "device", "seed"} <= set(loaded.provenance)


def test_a_checkpoint_of_a_system_that_is_not_here_is_refused(tmp_path):
    register_model("mean_place")(LitMean)
    save(create_model("mean_place"), tmp_path / "last.ckpt")
    del registry._MODELS["mean_place"]
    with pytest.raises(InputError, match="mean_place"):
        Checkpoint.read(tmp_path / "last.ckpt").system()


class Malicious:
    """Unpickling it creates a file."""

    def __init__(self, path) -> None:
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


def write_zip(value, path) -> None:
    torch.save(value, path)


def write_legacy(value, path) -> None:
    torch.save(value, path, _use_new_zipfile_serialization=False)


def write_pickle(value, path) -> None:
    path.write_bytes(pickle.dumps(value, protocol=2))


READERS = pytest.mark.parametrize(
    "read",
    [Checkpoint.read, lambda path: start_from(nn.Linear(1, 1), path), LitMambaLoc.load_from_checkpoint,
     lambda path: LitMambaLoc.load_from_checkpoint(path, weights_only=False)],
    ids=["read", "warm_start", "load_from_checkpoint", "asked_for_pickles"],
)  # fmt: skip


def refused(read, path, match: str) -> None:
    with pytest.raises(InputError, match=match) as error:
        read(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@READERS
@pytest.mark.parametrize("write", [write_zip, write_legacy, write_pickle])
def test_code_in_a_checkpoint_is_refused_and_not_run(tmp_path, read, write):
    path, touched = tmp_path / "gift.ckpt", tmp_path / "touched"
    write({"mambaloc": {"model": "mambaloc"}, "state_dict": {}, "gift": Malicious(touched)}, path)
    refused(read, path, "refused, since loading it could run code")
    assert not touched.exists()
    (pickle.loads(path.read_bytes()) if write is write_pickle else torch.load(path, weights_only=False))["gift"].close()
    assert touched.exists()  # the file was malicious indeed


@READERS
@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.999])
@pytest.mark.parametrize("write", [write_zip, write_legacy])
def test_a_truncated_checkpoint_is_refused(tmp_path, read, write, kept):
    path = tmp_path / "last.ckpt"
    write({"mambaloc": {"model": "mambaloc"}, "state_dict": {"a": torch.arange(1000)}}, path)
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    refused(read, path, "cannot be read as a checkpoint|refused")


@READERS
@pytest.mark.parametrize("content", [b"hello, I am a text file\n", b"lr: 0.1\n", b"\x89PNG\r\n\x1a\n", b"\x80\x02}"])
def test_other_files_are_refused(tmp_path, read, content):
    (tmp_path / "other.ckpt").write_bytes(content)
    refused(read, tmp_path / "other.ckpt", "cannot be read as a checkpoint|refused")


@READERS
@pytest.mark.parametrize("value", [{"state_dict": {"a": torch.zeros(2)}}, torch.zeros(2), [1, 2], {}], ids=str)
def test_torch_files_that_are_not_ours_are_refused(tmp_path, read, value):
    torch.save(value, tmp_path / "other.ckpt")
    refused(read, tmp_path / "other.ckpt", "not a MambaLoc checkpoint")


@READERS
def test_missing_checkpoints_and_folders_are_refused(tmp_path, read):
    refused(read, tmp_path / "gone.ckpt", "no such checkpoint")
    refused(read, tmp_path, "no such checkpoint")


class LitUnnamed(LitPoseRegressor):
    def configure_network(self) -> Mean:
        return Mean()


def test_a_class_without_a_name_is_refused_before_it_is_trained():
    with pytest.raises(InputError, match=r"LitUnnamed: has no name.*Write @register_model\('NAME'\) above the class"):
        LitUnnamed().setup("fit")


def test_a_released_model_is_loaded_and_not_created():
    with pytest.raises(InputError, match=r"create_model\('denseloc.embedded_room', pretrained=True\)"):
        create_model("denseloc.embedded_room")


def test_a_package_that_cannot_be_loaded_is_named(tmp_path, monkeypatch):
    about = tmp_path / "others-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[mambaloc.models]\nothers = others_that_are_not_there:Lit\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert "others" in list_models()
    with pytest.raises(InputError, match="package others cannot be loaded"):
        create_model("others")
