"""A sparse map beside the network: which frames it is built from, when, and what happens where there can be none."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.callbacks import MapBuild, map_build
from mambaloc.cli import main
from mambaloc.console import configure_logging
from mambaloc.data import PoseDataModule
from mambaloc.data.datasets.capture import COLUMNS
from mambaloc.errors import InputError, InputWarning
from mambaloc.runtime.maps import SparseMap

SMALL = {"image_size": 32, "short_side": 36}
SETTINGS = {"width": 160, "key_frames": 30}


def run_of(data, out, **changed):
    data.setup("fit")
    return SimpleNamespace(
        **{"datamodule": data, "default_root_dir": str(out), "fast_dev_run": False, "is_global_zero": True, **changed}
    )


def data_of(den, **options):
    return PoseDataModule("7scenes", str(den), "den", **{**SMALL, "validation": "none", **options})


def frames_of(sparse_map, den):
    """Numbers of the frames of ``seq-01`` that are nearest to the key frames."""
    given_m = np.stack([np.loadtxt(den / f"den/seq-01/frame-{number:06d}.pose.txt")[:3, 3] for number in range(32)])
    apart_m = np.linalg.norm(sparse_map.key_poses[:, None, :3, 3] - given_m, axis=-1)
    assert apart_m.min(axis=1).max() < 0.02
    return apart_m.argmin(axis=1).tolist()


@pytest.fixture
def capture(den, tmp_path):
    """``den`` as an imported scene."""
    folder = tmp_path / "capture"
    shutil.copytree(den / "den", folder, ignore=shutil.ignore_patterns("scene.json"))
    note = json.loads((den / "den" / "scene.json").read_text())
    (fx, _, cx), (_, fy, cy), _ = note["intrinsics_px"]
    lines = [",".join(COLUMNS)]
    for path in sorted(folder.glob("seq-*/*.pose.txt")):
        matrix = np.loadtxt(path)
        quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True)[[3, 0, 1, 2]]
        pose = ",".join(repr(float(n)) for n in (*matrix[:3, 3], *quaternion))
        (image,) = path.parent.glob(path.name.replace("pose.txt", "color.*"))
        split = "test" if path.parent.name == "seq-02" else "train"
        lines.append(f"{image.relative_to(folder)},{path.parent.name},0,{pose},phone,{split}")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    camera = {"width": 160, "height": 120, "focal_px": [fx, fy], "centre_px": [cx, cy]}
    scene = {"mambaloc_scene": 1, "unit": "metre", "cameras": {"phone": camera}, "sanity": {"verdict": "usable"}}
    (folder / "scene.json").write_text(json.dumps(scene))
    return folder


# --- which frames ----------------------------------------------------------------------------------------------------


def test_it_is_built_from_the_frames_that_are_trained_on_and_no_others(den, tmp_path, capsys):
    data = data_of(den, validation="block", val_fraction=0.2, val_gap=2)  # of 32: 24 to train on, 6 to validate on
    run = run_of(data, tmp_path)
    configure_logging()  # as tools do: the log goes to stderr
    capsys.readouterr()
    MapBuild(enabled=True, **SETTINGS).on_fit_start(run, None)
    built = SparseMap.load(tmp_path / "map/map.safetensors")
    assert frames_of(built, den) == list(range(24))
    assert built.scene == "den"
    assert built.digests["frames"] == data.chosen_training_frames().digest()
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{tmp_path}/map/map.safetensors: points triangulated: {len(built)}, in 24 key frames, ")


def test_frames_that_are_thinned_away_are_not_in_it(den, tmp_path):
    MapBuild(enabled=True, **SETTINGS).on_fit_start(run_of(data_of(den, keep_every=2), tmp_path), None)
    built = SparseMap.load(tmp_path / "map/map.safetensors")
    assert frames_of(built, den) == list(range(0, 32, 2))


# --- when ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("enabled", "is_capture", "is_built"), [(None, True, True), (None, False, False)])
def test_captures_have_one_unless_said_otherwise(enabled, is_capture, is_built, den, capture, tmp_path):
    data = PoseDataModule(scene=str(capture), **SMALL, validation="none") if is_capture else data_of(den)
    MapBuild(enabled, **SETTINGS).on_fit_start(run_of(data, tmp_path), None)
    assert (tmp_path / "map/map.safetensors").is_file() is is_built


@pytest.mark.parametrize("changed", [{"is_global_zero": False}, {"fast_dev_run": 1}])
def test_other_ranks_and_trial_runs_build_none(changed, den, tmp_path):
    MapBuild(enabled=True, **SETTINGS).on_fit_start(run_of(data_of(den), tmp_path, **changed), None)
    assert not (tmp_path / "map").exists()


def test_a_resumed_run_keeps_its_map_unless_frames_or_settings_changed(den, tmp_path, monkeypatch, capsys):
    configure_logging()
    built = []
    build = map_build.build_map
    monkeypatch.setattr(map_build, "build_map", lambda *args, **kwargs: built.append(args) or build(*args, **kwargs))
    start = lambda settings, **options: MapBuild(True, **settings).on_fit_start(  # noqa: E731
        run_of(data_of(den, **options), tmp_path), None
    )
    start(SETTINGS)
    start(SETTINGS)
    assert len(built) == 1
    assert "is built from these frames already" in capsys.readouterr().err
    start({**SETTINGS, "key_frames": 20})
    assert len(built) == 2
    start({**SETTINGS, "key_frames": 20}, keep_every=2)
    assert len(built) == 3
    (tmp_path / "map/map.safetensors").write_bytes(b"damaged")
    start({**SETTINGS, "key_frames": 20}, keep_every=2)
    assert len(built) == 4
    assert len(SparseMap.load(tmp_path / "map/map.safetensors").key_poses) == 16


@pytest.mark.slow
def test_a_resumed_command_leaves_the_file_alone(trained_with_map, tmp_path, capsys):
    run = shutil.copytree(trained_with_map, tmp_path / "run")
    before = (run / "map/map.safetensors").stat()
    recipe, last = trained_with_map.parent / "recipe.yaml", run / "checkpoints/last.ckpt"
    settings = ["--map.enabled", "true", "--map.width", "160", "--map.key_frames", "30"]
    main([str(recipe), *settings, "--ckpt_path", str(last), "--trainer.max_epochs", "2"])
    after = (run / "map/map.safetensors").stat()
    assert (before.st_ino, before.st_mtime_ns) == (after.st_ino, after.st_mtime_ns)
    output = capsys.readouterr()
    assert f"{run}/map/map.safetensors: is built from these frames already" in output.err
    assert "last and map" in output.out


# --- where there can be none -----------------------------------------------------------------------------------------


def test_unknown_cameras_are_a_warning(capture, tmp_path):
    scene = json.loads((capture / "scene.json").read_text())
    scene["cameras"]["phone"].pop("focal_px")
    (capture / "scene.json").write_text(json.dumps(scene))
    data = PoseDataModule(scene=str(capture), **SMALL, validation="none")
    with pytest.warns(InputWarning, match=r"focal length .* The training goes on without a map"):
        MapBuild(**SETTINGS).on_fit_start(run_of(data, tmp_path), None)
    assert not (tmp_path / "map").exists()


def test_frames_that_give_no_map_are_a_warning_and_an_older_map_goes(den, tmp_path):
    (tmp_path / "map").mkdir()
    (tmp_path / "map/map.safetensors").write_bytes(b"of other frames")
    with pytest.warns(InputWarning, match="needs two frames or more, but it has 1"):
        MapBuild(True, **SETTINGS).on_fit_start(run_of(data_of(den, keep_count=1), tmp_path), None)
    assert not (tmp_path / "map/map.safetensors").exists()


@pytest.mark.parametrize(("name", "value"), [("key_frames", 1), ("width", 8), ("most_bytes", 0), ("seed", -1)])
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(InputError, match=rf"map\.{name} {value}: is less than"):
        MapBuild(**{name: value})


@pytest.mark.slow
def test_a_run_goes_on_without_a_map(tiny_recipe, tmp_path, capsys):
    run = ["--trainer.default_root_dir", str(tmp_path / "run"), "--trainer.max_epochs", "1", "--data.keep_count", "1"]
    with pytest.warns(InputWarning, match=r"needs two frames or more.* The training goes on without a map\."):
        main([str(tiny_recipe), *run, "--map.enabled", "true"])
    assert "and map" not in capsys.readouterr().out
    assert (tmp_path / "run/checkpoints/last.ckpt").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--map.key_frames", "1"], ["--map.widht", "320"], ["--map.width", "wide"]])
def test_wrong_options_are_one_line(words, tiny_recipe, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([str(tiny_recipe), *words])
    assert exit_.value.code == 2
    error = capsys.readouterr().err.strip()
    assert words[0].removeprefix("--") in error
    assert len(error.splitlines()) == 1
