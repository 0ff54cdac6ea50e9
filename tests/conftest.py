"""Data that every test may use: tiny rendered scenes, small recipes, and what trainings and exports of them leave.

What costs seconds is made once a session, by whichever worker needs it first, and is read only: a test that changes a
file copies the folder to its own ``tmp_path``.
"""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings
from tiny import LAB_OFFSET_M, TINY_BACKBONE, TINY_MAMBALOC, TWO_SCENES, write_recipe

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # each worker a core of its own; read when torch is imported

settings.register_profile("ci", max_examples=100, deadline=None)
settings.register_profile("nightly", max_examples=1000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


@pytest.fixture
def offline_timm(monkeypatch):
    """timm without a network: pretrained weights cannot be fetched."""
    import timm

    create = timm.create_model

    def offline(*args, pretrained=False, **kwargs):
        if pretrained:
            raise OSError("no network")
        return create(*args, **kwargs)

    monkeypatch.setattr(timm, "create_model", offline)


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory) -> Callable[[str, Callable[[Path], object]], Path]:
    """``shared_folder(name, make)``: the folder of a name, which ``make(folder)`` fills once for all xdist workers."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    shared.mkdir(exist_ok=True)

    def make_once(name: str, make: Callable[[Path], object]) -> Path:
        folder, done = shared / name, shared / f"{name}.done"
        with FileLock(shared / f"{name}.lock"):
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return make_once


@pytest.fixture(scope="session", autouse=True)
def cache_dir(shared_folder):
    """A cache of the session's own, seen by subprocesses too: tests neither use nor fill the user's."""
    folder = shared_folder("cache", lambda folder: None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MAMBALOC_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def scenes(shared_folder):
    """A folder of rendered scenes in the 7-Scenes layout; ``heads`` has 2 x 12 training and 8 test frames."""
    from mambaloc.rendering.scenes.layouts import write_7scenes
    from mambaloc.rendering.scenes.shots import frames_of_sequences
    from mambaloc.rendering.trajectories import smooth_trajectory

    def render(root: Path) -> None:
        inside_m = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))
        sequences = {n: smooth_trajectory(8 if n == 3 else 12, seed=n, inside_m=inside_m) for n in (1, 2, 3)}
        write_7scenes(root, "heads", frames_of_sequences(sequences, {3}), size=(96, 72), depth=True)

    return shared_folder("scenes", render)


@pytest.fixture(scope="session")
def heads_and_lab(shared_folder, scenes):
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
        world = {"offset_m": LAB_OFFSET_M, "metres_per_unit": 1.0}
        (lab / "scene.json").write_text(json.dumps({**note, "world": world}))

    return shared_folder("heads_and_lab", render)


@pytest.fixture(scope="session")
def den(shared_folder):
    """A root with one scene, the embedded room in the 7-Scenes layout: 32 training and 6 test frames of 160x120."""
    from mambaloc.rendering import embedded_room, embedded_walk, frames_of_sequences, write_7scenes

    def render(root: Path) -> None:
        walks = {number: embedded_walk(count, number, 0.0, 360 / count) for number, count in ((1, 32), (2, 6))}
        write_7scenes(root, "den", frames_of_sequences(walks, {2}), room=embedded_room(), size=(160, 120))

    return shared_folder("den", render)


@pytest.fixture(scope="session")
def map_of_den(shared_folder, den):
    """The file of a sparse map of the den's training frames."""
    from mambaloc.mapping import MapSettings, build_map
    from mambaloc.mapping.posed import read_frames
    from mambaloc.mapping.recipe import MapRecipe
    from mambaloc.runtime.maps import MAP_FILE

    def build(folder: Path) -> None:
        train = read_frames(MapRecipe("den", root=str(den)), "train")
        build_map(train, MapSettings(width=160), "den").save(folder / MAP_FILE)

    return shared_folder("map_of_den", build) / "map.safetensors"


@pytest.fixture
def tiny_recipe(scenes, tmp_path):
    """A recipe that trains on ``scenes`` in about a second an epoch; its runs go under ``tmp_path``."""
    model = {"class_path": "LitMambaLoc", "init_args": TINY_MAMBALOC}
    return write_recipe(tmp_path / "tiny.yaml", scenes, model, {"validation": "sequences"}, max_epochs=4)


@pytest.fixture(scope="session")
def trained(shared_folder, scenes):
    """The folder of a tiny MambaLoc's run of three epochs, validated on a sequence: every file that a run leaves."""
    from mambaloc.cli import main

    def train(folder: Path) -> None:
        model = {"class_path": "LitMambaLoc", "init_args": TINY_MAMBALOC}
        recipe = write_recipe(folder / "recipe.yaml", scenes, model, {"validation": "sequences"}, max_epochs=3)
        options = ["--onnx_export.enabled", "true", "--trajectory_plot.every_n_epochs", "2"]
        options += ["--wall_clock.reach", '{"position_error_m": 1000}', "--trainer.default_root_dir"]
        main([str(recipe), *options, str(folder / "run")])

    return shared_folder("trained", train) / "run"


@pytest.fixture(scope="session")
def trained_student(shared_folder, scenes):
    """The folder of a tiny student's run of one epoch without validation; ``recipe.yaml`` lies in it."""
    from mambaloc.cli import main

    def train(folder: Path) -> None:
        model = {"class_path": "LitStudent", "init_args": {"backbone": TINY_BACKBONE, "width": 16}}
        recipe = write_recipe(folder / "recipe.yaml", scenes, model, {"validation": "none"}, max_epochs=1)
        main([str(recipe), "--trainer.default_root_dir", str(folder)])

    return shared_folder("trained_student", train)


@pytest.fixture(scope="session")
def trained_with_map(shared_folder, den):
    """The folder of a tiny MambaLoc's run of one epoch in ``den``, without validation, and of its map."""
    from mambaloc.cli import main

    def train(folder: Path) -> None:
        model = {"class_path": "LitMambaLoc", "init_args": TINY_MAMBALOC}
        recipe = write_recipe(folder / "recipe.yaml", den, model, {"scene": "den", "validation": "none"}, max_epochs=1)
        options = ["--map.enabled", "true", "--map.width", "160", "--map.key_frames", "30"]
        main([str(recipe), *options, "--trainer.default_root_dir", str(folder / "run")])

    return shared_folder("trained_with_map", train) / "run"


@pytest.fixture(scope="session")
def trained_on_two(shared_folder, heads_and_lab):
    """The folder of a tiny DenseLoc's run of 30 epochs on two scenes."""
    from mambaloc.cli import main

    def train(folder: Path) -> None:
        sizes = {"backbone": TINY_BACKBONE, "dim": 16, "heads": 2, "encoder_layers": 1, "feedforward": 16}
        model = {"class_path": "LitDenseLoc", "init_args": {**sizes, "lr": 0.003, "normalise_position": True}}
        data = {"scenes": TWO_SCENES, "batch_size": 8, "validation": "block", "val_gap": 1, "val_fraction": 0.4}
        data |= {"brightness": 0.0, "contrast": 0.0, "saturation": 0.0}  # colours tell the two rooms apart
        recipe = write_recipe(folder / "recipe.yaml", heads_and_lab, model, data, max_epochs=30)
        main([str(recipe), "--onnx_export.enabled", "true", "--trainer.default_root_dir", str(folder / "run")])

    return shared_folder("trained_on_two", train) / "run"


@pytest.fixture(scope="session")
def bundle_of_two(shared_folder, trained_on_two):
    """A bundle of a network that knows two scenes: float32 and float16 models that take images as they are."""
    from mambaloc.export import write_bundle
    from mambaloc.models import Checkpoint

    def export(folder: Path) -> None:
        checkpoint = Checkpoint.read(trained_on_two / "checkpoints/best.ckpt")
        write_bundle(checkpoint.system(), checkpoint.data(), folder / "bundle", ("onnx", "fp16"), "web")

    return shared_folder("bundle_of_two", export) / "bundle"


@pytest.fixture(scope="session")
def bundle_of_tensors(shared_folder, trained_student):
    """A bundle of the tiny student: float32, float16 and ORT models that take normalised tensors."""
    return _bundle(shared_folder, "bundle_of_tensors", trained_student, raw_input=False)


@pytest.fixture(scope="session")
def bundle_of_pictures(shared_folder, trained_student):
    """The same, with resizing, cropping and scaling inside the models."""
    return _bundle(shared_folder, "bundle_of_pictures", trained_student, raw_input=True)


def _bundle(shared_folder, name: str, run: Path, raw_input: bool) -> Path:
    from mambaloc.export import write_bundle
    from mambaloc.zoo.bundles import load_with_data

    def export(folder: Path) -> None:
        system, data = load_with_data(str(run / "checkpoints/last.ckpt"))
        write_bundle(system, data, folder / "bundle", ("onnx", "fp16", "ort"), raw_input=raw_input)

    return shared_folder(name, export) / "bundle"


@pytest.fixture(scope="session")
def bundles_for_lenses(shared_folder, den):
    """Bundles of a tiny DenseLoc: ``tensors``, and ``pictures``, which are taken as they are.

    Not in float16: an untrained network's rays hardly determine a rotation, so that rounding turns it by degrees.
    """
    import torch

    from mambaloc.data import PoseDataModule
    from mambaloc.export import onnx, write_bundle
    from mambaloc.models.denseloc import LitDenseLoc

    def export(folder: Path) -> None:
        size, formats = (64, 96), ("onnx", "ort")
        data = PoseDataModule("7scenes", str(den), "den", image_size=size, short_side=72, validation="none")
        data.setup("fit")
        torch.manual_seed(0)
        system = LitDenseLoc(TINY_BACKBONE, dim=16, heads=2, encoder_layers=1, feedforward=16, image_size=size).eval()
        network = system.network
        network.head.position_scale.fit(data.train_position_m)
        network.default_intrinsics.copy_(data.train_intrinsics.median(dim=0).values)
        write_bundle(system, data, folder / "tensors", formats, "web", raw_input=False)
        with pytest.MonkeyPatch.context() as patch:  # the conversion takes seconds
            patch.setattr(onnx, "_write", lambda *_: shutil.copyfile(folder / "tensors/model.onnx", _[-1]))
            write_bundle(system, data, folder / "pictures", formats, "web", raw_input=True)

    return shared_folder("bundles_for_lenses", export)
