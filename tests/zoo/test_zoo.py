"""Publishing, and loading from everywhere, on a tiny training."""

import hashlib
import pickle
import shutil
from dataclasses import replace

import pytest
import torch
import yaml

import mambaloc
from mambaloc.cli import main
from mambaloc.errors import InputError
from mambaloc.mapping import MapSettings, build_map
from mambaloc.mapping.posed import read_frames
from mambaloc.mapping.recipe import MapRecipe
from mambaloc.models.mambaloc import LitMambaLoc
from mambaloc.zoo import Manifest, list_released, load
from mambaloc.zoo.bundles import map_of
from mambaloc.zoo.publishing import card, publish


@pytest.fixture(scope="module")
def run(trained, scenes, tmp_path_factory):
    """The tiny system on images that are not square, with a map beside it."""
    folder = tmp_path_factory.mktemp("run")
    words = ["--data.image_size", "[32, 36]", "--trainer.default_root_dir", str(folder)]
    main([str(trained.parent / "recipe.yaml"), *words])
    frames = read_frames(MapRecipe("heads", root=str(scenes)), "train")
    build_map(frames, MapSettings(width=96, least_inliers=8), "heads").save(folder / "map/map.safetensors")
    return folder


@pytest.fixture(scope="module")
def released(run, tmp_path_factory):
    return publish(run / "checkpoints/best.ckpt", "tiny", tmp_path_factory.mktemp("zoo"), "cpu")


@pytest.fixture
def copy(released, tmp_path):
    return shutil.copytree(released, tmp_path / released.name)


pytestmark = pytest.mark.slow


def test_what_is_released_is_what_was_trained(run, released):
    system, checkpoint = load(f"local-dir:{released}"), mambaloc.load(run / "checkpoints/best.ckpt")
    assert type(system) is LitMambaLoc
    assert not system.training
    image = torch.rand(2, 3, 32, 36)
    with torch.no_grad():
        assert torch.equal(system(image).position_m, checkpoint(image).position_m)
        assert torch.equal(system(image).quaternion, checkpoint(image).quaternion)
    assert system.provenance["commit"] == checkpoint.provenance["commit"]


def test_weights_of_half_precision_are_half_as_large(run, released, tmp_path):
    folder = publish(run / "checkpoints/best.ckpt", "tiny", tmp_path, "cpu", half=True)
    whole, half = (Manifest.read(each) for each in (released, folder))
    assert (whole.weights_dtype, half.weights_dtype) == ("float32", "float16")
    assert half.weights_bytes < 0.6 * whole.weights_bytes
    assert "float16" in (folder / "README.md").read_text()
    states = [load(f"local-dir:{each}").network.state_dict() for each in (released, folder)]
    for name, tensor in states[1].items():
        assert tensor.dtype == states[0][name].dtype
        torch.testing.assert_close(tensor, states[0][name], rtol=1e-3, atol=1e-6)


def test_every_figure_says_where_it_is_from(released):
    manifest = Manifest.read(released)
    (result,) = manifest.results
    assert (result.data, result.split, result.n, result.seed) == ("7scenes/heads", "test", 8, 0)
    assert result.selection.startswith("best: lowest val/loss on frames held out")
    assert result.official_split is False
    assert result.seconds > 0
    assert len(result.commit) >= 40
    assert manifest.trained["recipe_sha256"]
    assert manifest.weights_bytes == (released / "weights.safetensors").stat().st_size
    assert "non-commercial" in manifest.licence
    card = (released / "README.md").read_text()
    assert f"{result.position_error_m:.3f} m" in card
    assert "no official split" in card


def test_the_runs_map_is_released_with_it(run, released):
    manifest, path = Manifest.read(released), released / "map.safetensors"
    assert path.read_bytes() == (run / "map/map.safetensors").read_bytes()
    assert manifest.map_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert manifest.map_bytes == path.stat().st_size
    assert map_of(f"local-dir:{released}") == path
    assert map_of(str(run / "checkpoints/best.ckpt")) == run / "map/map.safetensors"
    assert "sparse map, 0." in (released / "README.md").read_text()


def test_a_model_may_be_released_without_a_map(copy, trained):
    assert map_of(str(trained / "checkpoints/best.ckpt")) is None
    manifest = replace(Manifest.read(copy), map_sha256=None, map_bytes=None)
    (copy / "manifest.yaml").write_text(manifest.to_yaml())
    assert "map_" not in manifest.to_yaml()
    assert Manifest.read(copy) == manifest
    assert map_of(f"local-dir:{copy}") is None
    assert "sparse map" not in card("mambaloc.tiny", manifest)


def test_a_card_says_what_the_system_is(released):
    manifest = replace(Manifest.read(released), model="transbonet")
    assert "No code was published; this is from its description" in card("transbonet.tiny", manifest)


def test_a_name_finds_it(released, monkeypatch):
    monkeypatch.setattr("mambaloc.zoo.loading._ZOO", released.parent)
    assert list_released() == ["mambaloc.tiny"]
    assert type(mambaloc.load("mambaloc.tiny")) is LitMambaLoc
    with pytest.raises(InputError, match=r"mambaloc\.tin: no such model. Did you mean mambaloc\.tiny"):
        mambaloc.load("mambaloc.tin")
    with pytest.raises(InputError, match="hf-hub:ORG/NAME@REVISION"):
        mambaloc.load("something else")


def test_the_hub_is_asked_for_one_revision_and_remembers(released, monkeypatch):
    asked = []

    def online(repository, revision, allow_patterns, local_files_only=False):
        asked.append((repository, revision, local_files_only))
        if "offline" in repository and not local_files_only:
            raise ConnectionError("no network")
        if "nowhere" in repository:
            raise FileNotFoundError("not kept")
        return str(released)

    monkeypatch.setattr("mambaloc.zoo.loading.snapshot_download", online)
    assert type(load("hf-hub:org/name@abc")) is LitMambaLoc
    assert type(load("hf-hub:org/offline@abc")) is LitMambaLoc
    assert asked == [("org/name", "abc", False), ("org/offline", "abc", False), ("org/offline", "abc", True)]
    with pytest.raises(InputError, match="names no revision"):
        load("hf-hub:org/name")
    with pytest.raises(InputError, match=r"cannot be fetched.*no network"):
        load("hf-hub:org/offline-nowhere@abc")


# --- what is refused --------------------------------------------------------------------------------------------------


def refused(folder, message):
    with pytest.raises(InputError, match=message) as error:
        load(f"local-dir:{folder}")
    assert "\n" not in str(error.value)


def test_changed_weights_are_refused(copy):
    weights = copy / "weights.safetensors"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    refused(copy, "has another sha256")
    weights.unlink()
    refused(copy, "cannot be read")


def test_a_changed_map_is_refused_and_the_model_loads(copy):
    (copy / "map.safetensors").write_bytes((copy / "map.safetensors").read_bytes()[:-1])
    with pytest.raises(InputError, match=r"map\.safetensors: has another sha256"):
        map_of(f"local-dir:{copy}")
    assert type(load(f"local-dir:{copy}")) is LitMambaLoc
    (copy / "map.safetensors").unlink()
    with pytest.raises(InputError, match=r"map\.safetensors: cannot be read"):
        map_of(f"local-dir:{copy}")


def test_a_damaged_map_is_not_released(run, tmp_path):
    damaged = shutil.copytree(run, tmp_path / "run")
    (damaged / "map/map.safetensors").write_bytes(b"noise")
    with pytest.raises(InputError, match=r"map\.safetensors: is damaged"):
        publish(damaged / "checkpoints/best.ckpt", "tiny", tmp_path / "zoo", "cpu")
    assert not list((tmp_path / "zoo").glob("*"))


def test_a_pickle_in_place_of_weights_is_not_opened(copy):
    class Trap:
        def __reduce__(self):
            return pytest.fail, ("the pickle was opened",)

    content = pickle.dumps(Trap())
    (copy / "weights.safetensors").write_bytes(content)
    manifest = yaml.safe_load((copy / "manifest.yaml").read_text())
    manifest["weights_sha256"] = hashlib.sha256(content).hexdigest()
    (copy / "manifest.yaml").write_text(yaml.safe_dump(manifest))
    refused(copy, "does not fit mambaloc")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m["results"][0].pop("commit"), "result 1: missing field commit. Every result states its provenance"),
        (lambda m: m["results"][0].update(seconds=None), "result 1: missing field seconds"),
        (lambda m: m["results"][0].update(n="many"), "n is 'many'"),
        (lambda m: m.update(results=["0.1 m"]), "result 1: expected a mapping"),
        (lambda m: m.pop("licence"), "missing field licence"),
        (lambda m: m.update(extra=1), "unknown field extra"),
        (lambda m: m.update(manifest=2), "expected a manifest of version 1"),
        (lambda m: m.update(model="mambalock"), "mambalock"),
        (lambda m: m["arguments"].update(dim=32), "does not fit"),
        (lambda m: m["arguments"].update(dime=32), "does not fit"),
    ],
)
def test_manifests_are_checked(change, message, copy):
    manifest = yaml.safe_load((copy / "manifest.yaml").read_text())
    change(manifest)
    (copy / "manifest.yaml").write_text(yaml.safe_dump(manifest))
    refused(copy, message)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"{", b"[]", b"!!python/object/apply:os.system [ls]"])
def test_what_is_no_manifest(content, copy):
    (copy / "manifest.yaml").write_bytes(content)
    refused(copy, "manifest.yaml")


def test_a_name_is_not_taken_twice_nor_made_up(run, released):
    with pytest.raises(InputError, match="already exists"):
        publish(run / "checkpoints/best.ckpt", "tiny", released.parent, "cpu")
    with pytest.raises(InputError, match="choose another"):
        publish(run / "checkpoints/best.ckpt", "../tiny", released.parent, "cpu")


def test_what_does_not_measure_the_same_is_not_released(run, tmp_path, monkeypatch):
    def other(folder):
        system = mambaloc.load(run / "checkpoints/best.ckpt")
        with torch.no_grad():
            system.network.head.position[0].bias.add_(5)
        return system

    monkeypatch.setattr("mambaloc.zoo.publishing.load_released", other)
    with pytest.raises(InputError, match="where the checkpoint's was"):
        publish(run / "checkpoints/best.ckpt", "tiny", tmp_path / "zoo", "cpu")
    assert not list((tmp_path / "zoo").iterdir())


def test_an_installed_package_publishes_too(run, tmp_path, monkeypatch):
    """Outside a checkout there is no commit: the result names the installed release."""
    monkeypatch.setattr("mambaloc.provenance.commit", lambda: None)
    folder = publish(run / "checkpoints/best.ckpt", "tiny", tmp_path, "cpu")
    (result,) = Manifest.read(folder).results
    assert result.commit == f"release {mambaloc.__version__}"
    assert f"| {result.commit} |" in (folder / "README.md").read_text()
