"""tools/map.py on a map: what is added, removed, drawn and measured, and wrong uses in one line each."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from mambaloc.commands import map as map_command
from mambaloc.images import read_image
from mambaloc.rendering import embedded_room, frames_of_sequences, write_7scenes
from mambaloc.runtime.maps import SparseMap

ROOT = Path(__file__).parents[2]


def main(*argv):
    map_command.main([str(each) for each in argv])


@pytest.fixture
def folder(part, tmp_path):
    """Of a map."""
    part.save(tmp_path / "part" / "map.safetensors")
    return tmp_path / "part"


@pytest.fixture(scope="module")
def pictures(walk, tmp_path_factory):
    """Images without poses, most of them of what the map does not know."""
    out = tmp_path_factory.mktemp("more") / "balcony"
    out.mkdir()
    for row in range(34, 48, 2):
        cv2.imwrite(str(out / f"{row}.png"), walk.frames.images[row][..., ::-1])
    cv2.imwrite(str(out / "blank.png"), np.full((120, 160, 3), 90, np.uint8))
    return out


@pytest.fixture(scope="module")
def den(walk, tmp_path_factory):
    """A recipe of a scene whose three test frames the map knows in part."""
    root = tmp_path_factory.mktemp("scenes")
    walks = {1: walk.frames.world_from_cam[:2], 2: walk.frames.world_from_cam[[5, 41, 45]]}
    write_7scenes(root, "den", frames_of_sequences(walks, {2}), room=embedded_room(), size=(160, 120))
    recipe = root / "den.yaml"
    recipe.write_text(yaml.safe_dump({"scene": "den", "root": str(root), "ransac_seeds": [0]}))
    return recipe


def test_pictures_are_added_measured_and_removed_again(folder, pictures, den, tmp_path, capsys):
    before, out = (folder / "map.safetensors").read_bytes(), tmp_path / "grown"
    main(folder, "--add", pictures, "--out", out, "--test", den)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert "7 key frames and" in lines[0]
    assert lines[1] == "not found in the map: 1 frames, blank.png"
    assert lines[-3].startswith("before: ")
    assert lines[-2].startswith("after: ")
    assert lines[-2].endswith("100.0 % accepted")
    result = json.loads((out / "metrics.json").read_text())
    assert lines[-1].startswith(f"den: median {result['metrics']['position_error_m']:.3f} m / ")
    assert lines[-1].endswith(" ms a query")
    assert result["map"]["sessions"] == {"balcony": 7}
    assert result["map"]["settings"] == {"key_frames": 160, "most_bytes": 4 * 2**20}
    assert result["map"]["core_seconds"] > 0
    assert result["data"]["train_frames"] == 8
    assert (folder / "map.safetensors").read_bytes() == before
    assert SparseMap.load(out / "map.safetensors").sessions == {"balcony": 7}
    for name in ("coverage.png", "points.png"):
        assert min(read_image(out / name).shape[:2]) > 200
    main(out / "map.safetensors", "--remove", "balcony", "--out", out)
    assert (out / "map.safetensors").read_bytes() == before
    assert not list(out.glob(".*"))


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--add", "{pictures}"], r"map\.safetensors: would be overwritten\. Give --out FOLDER, which may be"),
        (
            ["--remove", "attic", "--out", "{out}"],
            r"attic: is not in the map of room\. Choose one of its sessions: none",
        ),
        (["--add", "{empty}", "--out", "{out}"], r"contains no image"),
        (["--add", "{out}/no.mp4", "--out", "{out}"], r"no such file"),
        (["--remove", "attic", "--out", "{out}", "--name", "attic"], r"--name: applies to --add alone\. Leave it out"),
        (["--intrinsics", "100,100,80,60"], r"--intrinsics: applies to --add alone\. Leave it out"),
        (["--add", "{pictures}", "--out", "{out}", "--width", "100"], r"exists already\. Leave out --width"),
        (["--test", "{den}", "--points", "colmap"], r"exists already\. Leave out --points"),
        (["--test", "{out}/no.yaml"], r"no\.yaml: cannot be read"),
        (["--add", "{strange}", "--out", "{out}"], r"strange: the map finds none of 3 frames\. Check that they show"),
        (["--add", "{den}", "--out", "{out}", "--intrinsics", "100,100,80,60"], r"Leave out --intrinsics"),
    ],
)
def test_wrong_uses_are_refused_in_a_line(folder, pictures, den, tmp_path, argv, message, capsys):
    for name in ("empty", "strange"):
        (tmp_path / name).mkdir()
    for row, noise in enumerate(np.random.default_rng(0).integers(0, 255, (3, 30, 40, 3), dtype=np.uint8)):
        cv2.imwrite(str(tmp_path / "strange" / f"{row}.png"), noise.repeat(4, 0).repeat(4, 1))
    places = {"pictures": pictures, "den": den, **{name: tmp_path / name for name in ("out", "empty", "strange")}}
    with pytest.raises(SystemExit) as exit_info:
        main(folder, *(each.format(**places) for each in argv))
    error = capsys.readouterr().err.strip()
    assert exit_info.value.code == 2
    assert len(error.splitlines()) == 1
    assert re.search(message, error)
    assert not (tmp_path / "out").exists()


def test_a_damaged_map_is_not_changed(folder, pictures, tmp_path, capsys):
    path = folder / "map.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(SystemExit):
        main(folder, "--add", pictures, "--out", tmp_path / "out")
    assert "is damaged or not a map" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_only_maps_grow(den, pictures, capsys):
    with pytest.raises(SystemExit):
        main(den, "--add", pictures)
    assert "is not a map" in capsys.readouterr().err


def test_intrinsics_are_four_numbers(folder, pictures, capsys):
    with pytest.raises(SystemExit):
        main(folder, "--add", pictures, "--intrinsics", "100,100")
    assert "give FX,FY,CX,CY in pixels" in capsys.readouterr().err
