"""What an installation without the extra ``train`` does, and what it says of the rest.

Here the extra's modules are only hidden; ``tests/test_distributions.py`` has an installation that lacks them.
"""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from mambaloc import commands

ROOT = Path(__file__).parents[2]
NEED_TORCH = ("train", "evaluate", "export", "visualize", "benchmark", "publish")
HIDDEN = sorted(commands._OF_TRAINING)


def mambaloc(*calls):
    """Run commands one after another in one process without the extra's modules, and return its end."""
    runs = "".join(f"sys.argv = ['mambaloc', *{list(map(str, words))}]; commands.main()\n" for words in calls)
    program = f"import sys\nsys.modules.update(dict.fromkeys({HIDDEN}))\nfrom mambaloc import commands\n{runs}"
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)


def test_the_extras_modules_are_those_that_are_known():
    """Each is called as its distribution is."""
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["train"]
    assert {Requirement(each).name.replace("-", "_") for each in extra} == commands._OF_TRAINING


@pytest.mark.nightly
def test_a_capture_becomes_a_map_that_localises(den, tmp_path):
    scene, out = tmp_path / "scene", tmp_path / "map"
    ended = mambaloc(
        ["import", den / "den", "--out", scene],
        ["map", scene, "--frames", 30, "--width", 160, "--out", out],
        ["localize", out / "map.safetensors", den / "den/seq-02", "--out", tmp_path / "poses.tum"],
        ["export-scene", scene, "--out", tmp_path / "kapture"],
    )
    assert ended.returncode == 0, ended.stderr
    poses = [line for line in (tmp_path / "poses.tum").read_text().splitlines() if not line.startswith("#")]
    assert len(poses) == 6


def test_a_bundle_and_a_map_localise(bundle_of_pictures, map_of_den, den, tmp_path):
    ended = mambaloc(
        ["verify", bundle_of_pictures],
        ["localize", bundle_of_pictures, den / "den/seq-02", "--out", tmp_path / "network.tum"],
        ["localize", map_of_den, den / "den/seq-02", "--out", tmp_path / "map.tum"],
    )
    assert ended.returncode == 0, ended.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"network.tum", "map.tum"}


@pytest.mark.parametrize("name", sorted(commands._MODULES.keys() - set(NEED_TORCH)))
def test_the_others_import_nothing_of_the_extra(name):
    assert mambaloc([name, "--help"]).returncode == 0


@pytest.mark.parametrize(
    ("words", "needy"),
    [
        *(([name, "x"], f"mambaloc {name}") for name in NEED_TORCH),
        (["sweep", "report", "x"], "mambaloc sweep"),
        (["localize", "x"], "mambaloc localize without a bundle"),
        (["demo", "--out", "page"], "mambaloc demo without a bundle"),
        (["serve"], "mambaloc serve without a bundle"),
    ],
)
def test_what_needs_torch_says_so_in_one_line(words, needy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    ended = mambaloc(words)
    line = f"error: {needy} needs PyTorch, which is not installed. Run: pip install 'mambaloc[train]'\n"
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", line)
    assert not list(tmp_path.iterdir())
