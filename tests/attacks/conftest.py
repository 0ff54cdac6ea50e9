"""Attacks are counted: ``pytest tests/attacks --tries 100`` prints what was tried, how often, and what happened."""

import json
import os
import shutil
from collections import Counter
from dataclasses import asdict

import pytest
import yaml
from hypothesis import settings

TALLY = pytest.StashKey[dict]()


def pytest_addoption(parser):
    parser.addoption("--tries", type=int, help="how often each attack is tried, and a table of them")


@pytest.fixture(scope="session")
def tries(request):
    """How often each attack is tried; once unless asked for."""
    return request.config.getoption("--tries", None) or 1


@pytest.fixture(scope="session")
def examples(tries):
    """How many inputs Hypothesis feeds a reader of files: 60, the profile's count by schedule, or ``--tries``."""
    scheduled = os.environ.get("HYPOTHESIS_PROFILE") == "nightly"
    return max(settings.default.max_examples if scheduled else 60, tries)


@pytest.fixture
def tally(request):
    """Count what happened: ``tally(attack, outcome)``."""
    table = request.config.stash.setdefault(TALLY, {})
    return lambda attack, outcome, count=1: table.setdefault(attack, Counter()).update({outcome: count})


@pytest.fixture(scope="session")
def inputs(shared_folder, scenes, trained):
    """A scene, a capture of it, a recipe, a training, a sweep of two such, an ONNX model and a bundle."""
    from subjects import bundle, export

    def gather(folder):
        (folder / "scenes").symlink_to(scenes)
        (folder / "run").symlink_to(trained)
        recipe = yaml.safe_load((trained.parent / "recipe.yaml").read_text())
        recipe["trainer"] |= {"max_epochs": 2, "limit_train_batches": 2}
        (folder / "recipe.yaml").write_text(yaml.safe_dump(recipe))
        seeds = {str(seed): ["--seed_everything", seed] for seed in range(2)}
        axes = {"system": {"mambaloc": [str(folder / "recipe.yaml")]}, "seed": seeds}
        (folder / "sweep.yaml").write_text(yaml.safe_dump({"axes": axes}))
        for kind, suffix, of in (("color", "png", "color.png"), ("pose", "txt", "pose.txt")):
            (folder / "capture" / kind).mkdir(parents=True)
            for number, file in enumerate(sorted((scenes / "heads").glob(f"seq-0[12]/*.{of}"))):
                shutil.copy(file, folder / "capture" / kind / f"{number}.{suffix}")
        export(folder, folder)
        bundle(folder, folder)

    return shared_folder("inputs of attacks", gather)


@pytest.fixture(scope="session")
def undisturbed(shared_folder, inputs):
    """``undisturbed(name)``: what a subject's operation comes to that nobody attacks; it runs once for all workers."""
    from attacked import Undisturbed, undisturbed_run
    from subjects import SUBJECTS

    def run(name):
        def measure(folder):
            found = undisturbed_run(SUBJECTS[name], inputs, folder / "out")
            (folder / "measured.json").write_text(json.dumps(asdict(found)))

        return Undisturbed(**json.loads((shared_folder(f"undisturbed {name}", measure) / "measured.json").read_text()))

    return run


def pytest_terminal_summary(terminalreporter, config):
    if not config.getoption("--tries", None):
        return
    terminalreporter.section("attacks")
    for attack, outcomes in config.stash.get(TALLY, {}).items():
        told = ", ".join(f"{outcome}: {count}" for outcome, count in sorted(outcomes.items()))
        terminalreporter.line(f"| {attack} | {sum(outcomes.values())} | {told} |")
