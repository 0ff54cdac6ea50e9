"""Seconds to given errors: from a training's clock by hand, and the whole on a rendered room."""

import json
import sys
from argparse import ArgumentTypeError

import pytest
import time_to_accuracy
import yaml
from time_to_accuracy import REACH, Errors, errors_sought, way_of_training

from mambaloc.errors import InputError

HISTORY = [
    {"train_s": 30.0, "step": 40, "position_error_m": 0.15, "rotation_error_deg": 7.0},
    {"train_s": 60.0, "step": 80, "position_error_m": 0.18, "rotation_error_deg": 5.0},
    {"train_s": 90.0, "step": 120, "position_error_m": 0.05, "rotation_error_deg": 2.0},
]


def test_both_errors_must_be_reached_and_all_before_the_first_step_counts():
    way = way_of_training("fast", 1000.0, {"began_at": 1020.0, "history": HISTORY})
    assert way.began_s == 20
    assert [way.seconds_to(sought) for sought in REACH] == [80, 80, 110, 110]
    assert way.seconds_to(Errors(0.16, 7.0)) == 50
    assert way.seconds_to(Errors(0.04, 90.0)) is None


def test_a_training_without_validation_is_refused():
    with pytest.raises(InputError, match=r"fast: nothing was validated\. Add .*watched"):
        way_of_training("fast", 0.0, {"began_at": 1.0, "history": []})


@pytest.mark.parametrize("text", ["0.2", "0.2/6/1", "near/6"])
def test_errors_sought_are_two_numbers(text):
    assert errors_sought("0.2/6") == Errors(0.2, 6.0)
    with pytest.raises(ArgumentTypeError, match="is not METRES/DEGREES"):
        errors_sought(text)


def test_trainings_and_maps_stand_in_one_table(tiny_recipe, den, tmp_path, monkeypatch, capsys):
    """Trains for an epoch, builds a map and pycolmap's model, each in a process of its own: some twenty seconds."""
    pytest.importorskip("pycolmap")
    scene = {"dataset": "7scenes", "root": str(den), "scene": "den"}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({**scene, "key_frames": 30, "width": 160}))
    axes = {"training": {"tiny": [str(tiny_recipe), "--trainer.max_epochs=1"]}}
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump({"axes": axes, "time_limit_s": 300, "cpus": 1}))
    options = ["--map", "map.yaml", "--frames", "28", "--reach", "50/180", "0.1/5", "0/0", "--out", "out"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["time_to_accuracy", "sweep.yaml", *options])
    time_to_accuracy.main()
    shown = capsys.readouterr().out
    result = json.loads((tmp_path / "out/time_to_accuracy.json").read_text())
    ways = {way["name"]: way for way in result["ways"]}
    assert list(ways) == ["tiny", "map, 28 key frames", "pycolmap, 28 key frames"]
    assert all(0 < way["began_s"] <= way["history"][0][0] < 300 for way in ways.values())
    assert ways["map, 28 key frames"]["history"][0][1]["position_m"] < 0.1
    assert all(name.split(",")[0] in shown for name in ways)
