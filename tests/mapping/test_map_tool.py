"""tools/map.py: recipes, what it writes, and real frames."""

import json
import runpy
from pathlib import Path

import pytest
import yaml

from mambaloc.errors import InputError
from mambaloc.mapping.building import MapSettings
from mambaloc.mapping.evaluating import build_and_measure
from mambaloc.mapping.recipe import MapRecipe, read_recipe
from mambaloc.runtime.maps import SparseMap

ROOT = Path(__file__).parents[2]
BLOCKS = ROOT / "recipes" / "map_redkitchen_blocks.yaml"


def main(argv):
    runpy.run_path(str(ROOT / "tools" / "map.py"))["main"](argv)


def test_a_recipe_is_built_measured_and_written(scenes, tmp_path, capsys):
    recipe = tmp_path / "heads.yaml"
    recipe.write_text(yaml.safe_dump({"scene": "heads", "root": str(scenes), "width": 96, "ransac_seeds": [0, 1]}))
    main([str(recipe), "--frames", "20", "--out", str(tmp_path / "out")])
    last = capsys.readouterr().out.splitlines()[-1]
    sparse_map = SparseMap.load(tmp_path / "out" / "map.npz")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert last.startswith(f"heads: median {metrics['metrics']['position_error_m']:.3f} m / ")
    for word in ("mean", "worst", "within 10 cm 5 deg", "MiB", "core-seconds", "ms a query"):
        assert word in last
    assert (sparse_map.scene, sparse_map.size, len(sparse_map.key_poses)) == ("heads", (96, 72), 20)
    assert (metrics["count"], metrics["ransac_seeds"], metrics["split"]) == (8, [0, 1], "test")
    assert metrics["data"]["train_frames"] == 24
    assert metrics["map"]["settings"]["key_frames"] == 20
    assert metrics["map"]["points"] == len(sparse_map)
    assert metrics["evaluation"]["commit"]


def test_the_recipe_of_the_blocks_is_read():
    recipe = read_recipe(BLOCKS)
    assert recipe.label == "redkitchen seq-01 blocks (800/200)"
    assert isinstance(recipe, MapRecipe)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "does not name a scene"),
        ("[1]", "does not name a scene"),
        ("scene: 3", "does not name a scene"),
        ("scene: a\nframes: 3", "'frames' is unknown"),
        ("scene: a\nwidth: wide", "width is 'wide'. Give a whole number of 32 or more"),
        ("scene: a\nkey_frames: true", "key_frames is 'True'"),
        ("scene: a\nkey_frames: 1", "key_frames is '1'. Give a whole number of 2 or more"),
        ("scene: a\nroot: 3", "root is '3'. Give a text"),
        ("scene: a\nransac_seeds: []", "ransac_seeds is '[]'. Give a list"),
        ("scene: a\nransac_seeds: 0", "ransac_seeds is '0'. Give a list"),
        ("scene: [", "is no YAML"),
    ],
)
def test_a_wrong_recipe_is_refused_in_a_line(tmp_path, text, message, capsys):
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(SystemExit) as exit_:
        main([str(path)])
    assert exit_.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_a_missing_recipe_and_too_few_frames_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"cannot be read"):
        read_recipe(tmp_path / "none.yaml")
    with pytest.raises(SystemExit):
        main([str(BLOCKS), "--frames", "1"])


@pytest.fixture
def blocks():
    folder = ROOT.parent / "shared" / "data" / "7scenes_blocks"
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}")
    return str(folder)


def test_real_frames_are_localised_to_centimetres(blocks, tmp_path):
    """Redkitchen seq-01 blocks (800/200), 40 key frames at 160x120."""
    recipe = MapRecipe("redkitchen", root=blocks, settings=MapSettings(40, 160, 2**18), ransac_seeds=(0,))
    metrics = build_and_measure(recipe, tmp_path)["metrics"]
    assert metrics["position_error_m"] < 0.05
    assert metrics["rotation_error_deg"] < 2
    assert (tmp_path / "map.npz").stat().st_size <= 2**18
