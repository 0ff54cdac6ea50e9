"""tools/map.py: recipes, what it writes, and real frames."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from mambaloc.commands.map import main
from mambaloc.data.datasets.registry import locate
from mambaloc.errors import InputError
from mambaloc.mapping import evaluating
from mambaloc.mapping.building import MapSettings
from mambaloc.mapping.evaluating import MapErrors, build_and_measure, covers
from mambaloc.mapping.recipe import MapRecipe, read_recipe, recipe_of
from mambaloc.runtime.maps import SparseMap

ROOT = Path(__file__).parents[2]
BLOCKS = ROOT / "recipes" / "map_redkitchen_blocks.yaml"


def test_a_recipe_is_built_measured_and_written(den, tmp_path, capsys):
    recipe = tmp_path / "den.yaml"
    recipe.write_text(yaml.safe_dump({"scene": "den", "root": str(den), "width": 160, "ransac_seeds": [0, 1]}))
    main([str(recipe), "--frames", "30", "--out", str(tmp_path / "out")])
    last = capsys.readouterr().out.splitlines()[-1]
    sparse_map = SparseMap.load(tmp_path / "out" / "map.safetensors")
    result = json.loads((tmp_path / "out" / "metrics.json").read_text())
    metrics = result["metrics"]
    assert last.startswith(f"den: median {metrics['position_error_m']:.3f} m / {metrics['rotation_error_deg']:.2f} deg")
    for word in ("mean", "worst", "within 10 cm 5 deg", "MiB", "core-seconds", "ms a query"):
        assert word in last
    assert metrics["position_error_m"] < 0.03
    assert (sparse_map.scene, sparse_map.size, len(sparse_map.key_poses)) == ("den", (160, 120), 30)
    assert (result["count"], result["ransac_seeds"], result["split"]) == (6, [0, 1], "test")
    assert (result["data"]["train_frames"], result["map"]["settings"]["key_frames"]) == (32, 30)
    assert result["map"]["points"] == len(sparse_map)
    assert result["evaluation"]["commit"]


def test_the_recipe_of_the_blocks_is_read():
    recipe = read_recipe(BLOCKS)
    assert recipe.label == "redkitchen seq-01 blocks (800/200)"
    assert isinstance(recipe, MapRecipe)


@pytest.mark.parametrize(
    ("here", "source"),
    [(".", "room"), (".", "./room"), ("..", "scenes/room"), ("room", "."), ("room/images", ".."), (".", "{}/room")],
)
def test_an_imported_scenes_folder_may_be_named_in_any_way(here, source, tmp_path, monkeypatch):
    """Guess: ``Path("./room")`` is ``Path("room")``, so that both were taken for a scene of 7-Scenes."""
    scenes = tmp_path / "scenes"
    (scenes / "room/images").mkdir(parents=True)
    (scenes / "room/scene.json").write_text('{"mambaloc_scene": 1}')
    monkeypatch.chdir(scenes / here)
    recipe = recipe_of(Path(source.format(scenes)))
    dataset, root, scene = locate(recipe.dataset, recipe.root, recipe.scene)
    assert (dataset, scene, recipe.name) == ("capture", "room", "room")
    assert Path(root).resolve() == scenes


def test_a_folder_that_is_not_a_scene_is_named_with_how_to_import_it(tmp_path, monkeypatch, capsys):
    (tmp_path / "photos").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        main(["photos"])
    assert "photos: is not an imported scene; make one with: mambaloc import photos" in capsys.readouterr().err


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
        ("scene: a\nroot: 3", "root is '3'. Give text"),
        ("scene: a\nransac_seeds: []", "ransac_seeds is '[]'. Give a list"),
        ("scene: a\nransac_seeds: 0", "ransac_seeds is '0'. Give a list"),
        ("scene: [", "is not YAML"),
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


@pytest.mark.parametrize(
    ("option", "least"),
    [(["--frames", "x"], 2), (["--frames", "1"], 2), (["--width", "31"], 32), (["--width", "9.5"], 32)],
)
def test_a_wrong_number_is_refused_in_a_line(option, least, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([str(BLOCKS), *option])
    assert exit_.value.code == 2
    name, value = option
    expected = f"error: {name}: {value}: give a whole number of at least {least}; --help lists the options\n"
    assert capsys.readouterr().err == expected


def test_frames_without_a_pose_count_in_medians_and_shares_but_not_in_means():
    errors, covered = np.array([[0.01, 0.03, np.inf], [1.0, 2.0, np.inf]]), np.array([1, 0, 1], bool)
    lost = MapErrors(*errors, np.array([1, 1, 0], bool), covered, np.ones(3))
    summary = lost.summary()
    assert summary["position_error_m"] == 0.03
    assert summary["position_error_mean_m"] == pytest.approx(0.02)
    assert summary["position_error_worst_m"] == np.inf
    assert summary["without_pose"] == summary["above_20cm"] == pytest.approx(1 / 3)
    assert summary["recall_10cm_5deg"] == pytest.approx(2 / 3)
    assert summary["accepted_and_wrong"] == 0
    assert summary["covariance_90"] == 0.5  # of the two that are accepted
    nowhere = MapErrors(
        np.full(3, np.inf), np.full(3, np.inf), np.zeros(3, bool), np.zeros(3, bool), np.ones(3)
    ).summary()
    assert nowhere["position_error_mean_m"] == nowhere["position_error_m"] == np.inf


def test_truths_are_covered_by_ellipsoids_as_often_as_they_say():
    """Errors are drawn from a covariance whose axes are turned; SciPy composes the rotations."""
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    axes = turn * [0.01, 0.02, 0.03, 0.001, 0.01, 0.03]
    position_m, rotation = rng.normal(size=3), Rotation.random(random_state=1)
    inside = []
    for off in rng.normal(size=(4000, 6)) @ axes.T:
        truth = np.eye(4)
        truth[:3, :3] = (Rotation.from_rotvec(off[3:]) * rotation).as_matrix()
        truth[:3, 3] = position_m + off[:3]
        inside.append(covers(position_m, rotation.as_quat(scalar_first=True), axes @ axes.T, truth))
    assert np.mean(inside) == pytest.approx(0.9, abs=0.015)
    assert not covers(position_m, rotation.as_quat(scalar_first=True), None, truth)
    assert not covers(np.full(3, np.nan), np.full(4, np.nan), np.full((6, 6), np.nan), truth)


def test_a_result_without_poses_is_written_as_json(den, tmp_path, monkeypatch):
    nowhere = MapErrors(np.full(8, np.inf), np.full(8, np.inf), *np.zeros((2, 8), bool), np.ones(8))
    monkeypatch.setattr(evaluating, "measure", lambda *_: nowhere)
    recipe = MapRecipe("den", root=str(den), settings=MapSettings(30, 160), ransac_seeds=(0,))
    assert "worst inf m" in build_and_measure(recipe, tmp_path).describe()
    metrics = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail)["metrics"]
    assert metrics["position_error_worst_m"] is None
    assert metrics["without_pose"] == 1


@pytest.fixture
def blocks():
    folder = ROOT.parent / "shared" / "data" / "7scenes_blocks"
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}")
    return str(folder)


def test_real_frames_are_localized_to_centimetres(blocks, tmp_path):
    """Redkitchen seq-01 blocks (800/200), 40 key frames at 160x120; measured: 0.041 m / 0.93 deg."""
    recipe = MapRecipe("redkitchen", root=blocks, settings=MapSettings(40, 160, 2**18), ransac_seeds=(0,))
    metrics = build_and_measure(recipe, tmp_path).result["metrics"]
    assert metrics["position_error_m"] < 0.05
    assert metrics["rotation_error_deg"] < 2
    assert (tmp_path / "map.safetensors").stat().st_size <= 2**18
