"""Attacks are counted: ``pytest tests/attacks --tries 100`` prints what was tried, how often, and what happened."""

import shutil
from collections import Counter

import pytest
import yaml

TALLY = pytest.StashKey[dict]()


def pytest_addoption(parser):
    parser.addoption("--tries", type=int, help="how often each attack is tried, and a table of them")


@pytest.fixture(scope="session")
def tries(request):
    """How often each attack is tried; once unless asked for."""
    return request.config.getoption("--tries", None) or 1


@pytest.fixture
def tally(request):
    """Count what happened: ``tally(attack, outcome)``."""
    table = request.config.stash.setdefault(TALLY, {})
    return lambda attack, outcome, count=1: table.setdefault(attack, Counter()).update({outcome: count})


@pytest.fixture(scope="session")
def inputs(scenes, tmp_path_factory):
    """A scene, a capture of it, a recipe, a training that it led to, and a matrix of two such."""
    from mambaloc.cli import main

    folder = tmp_path_factory.mktemp("inputs")
    (folder / "scenes").symlink_to(scenes)
    model = {"backbone": "resnet10t", "dim": 16, "heads": 2, "encoder_layers": 1, "feedforward": 16, "head_hidden": 16}
    data = {"root": str(scenes), "scene": "heads", "image_size": [32, 36], "short_side": 36, "validation": "sequences"}
    recipe = {
        "model": {"class_path": "LitMambaLoc", "init_args": {**model, "normalise_position": True}},
        "data": data,
        "trainer": {"max_epochs": 3, "accelerator": "cpu"},
        "onnx_export": {"enabled": False},
    }
    (folder / "recipe.yaml").write_text(yaml.safe_dump(recipe))
    seeds = {str(seed): ["--seed_everything", seed] for seed in range(2)}
    axes = {"system": {"mambaloc": [str(folder / "recipe.yaml")]}, "seed": seeds}
    (folder / "matrix.yaml").write_text(yaml.safe_dump({"axes": axes}))
    for kind, suffix, of in (("color", "png", "color.png"), ("pose", "txt", "pose.txt")):
        (folder / "capture" / kind).mkdir(parents=True)
        for number, file in enumerate(sorted((scenes / "heads").glob(f"seq-0[12]/*.{of}"))):
            shutil.copy(file, folder / "capture" / kind / f"{number}.{suffix}")
    main([str(folder / "recipe.yaml"), "--trainer.default_root_dir", str(folder / "run")])
    return folder


def pytest_terminal_summary(terminalreporter, config):
    if not config.getoption("--tries", None):
        return
    terminalreporter.section("attacks")
    for attack, outcomes in config.stash.get(TALLY, {}).items():
        told = ", ".join(f"{outcome}: {count}" for outcome, count in sorted(outcomes.items()))
        terminalreporter.line(f"| {attack} | {sum(outcomes.values())} | {told} |")
