"""Network, map, and both: each row of a result against a computation of its own."""

import csv
import hashlib
import json
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputWarning
from mambaloc.evaluation import evaluate_checkpoint, measure_map, measure_map_of_run, print_table
from mambaloc.models import Checkpoint
from mambaloc.runtime.maps import CameraPose, MapLocalizer, SparseMap
from mambaloc.uncertainty import Uncertainty

TOOL = Path(__file__).parents[2] / "tools/evaluate.py"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def unsure(trained_with_map, tmp_path_factory):
    """The run's map, which now accepts about half of the test frames."""
    path = trained_with_map / "map/map.safetensors"
    found = [localization for _, localization in in_map(SparseMap.load(path), frames_of(trained_with_map))]
    least = int(np.median([each.inliers for each in found])) + 1
    out = tmp_path_factory.mktemp("unsure") / "map.safetensors"
    replace(SparseMap.load(path), least_inliers=least).save(out)
    return out


@pytest.fixture(scope="module")
def measured(trained_with_map, unsure, tmp_path_factory):
    """Result and folder of an evaluation with that map."""
    out = tmp_path_factory.mktemp("measured")
    checkpoint = Checkpoint.read(trained_with_map / "checkpoints/last.ckpt")
    result = evaluate_checkpoint(checkpoint, out, accelerator="cpu", beside=measure_map(unsure, checkpoint.data()))
    return result, out


def frames_of(run):
    """Image and true pose of each test frame."""
    data = Checkpoint.read(run / "checkpoints/last.ckpt").data()
    folder = data.folder / "seq-02"
    poses = [np.loadtxt(path) for path in sorted(folder.glob("*.pose.txt"))]
    pictures = [cv2.imread(str(path))[..., ::-1] for path in sorted(folder.glob("*.color.*"))]
    intrinsics = np.array(json.loads((data.folder / "scene.json").read_text())["intrinsics_px"])
    return [(picture, intrinsics, pose) for picture, pose in zip(pictures, poses, strict=True)]


def in_map(sparse_map, frames, priors=None):
    localizer = MapLocalizer(sparse_map)
    for row, (picture, intrinsics, pose) in enumerate(frames):
        yield pose, localizer.localize(picture, intrinsics, priors[row] if priors else None)


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def pose_of(row, prefix="predicted"):
    x, y, z, qw, qx, qy, qz = (float(row[f"{prefix}_{name}"]) for name in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"))
    return np.array([x, y, z]), Rotation.from_quat([qx, qy, qz, qw])


def error_of(position_m, rotation, true):
    off = Rotation.from_matrix(true[:3, :3]).inv() * rotation
    return np.linalg.norm(position_m - true[:3, 3]), np.degrees(off.magnitude())


def assert_sums_up(metrics, errors):
    position_m, rotation_deg = np.array(errors).T
    assert metrics["position_error_m"] == pytest.approx(np.median(position_m), rel=1e-4)
    assert metrics["rotation_error_deg"] == pytest.approx(np.median(rotation_deg), rel=1e-3)
    assert metrics["position_error_mean_m"] == pytest.approx(np.mean(position_m), rel=1e-4)
    assert metrics["position_error_worst_m"] == pytest.approx(np.max(position_m), rel=1e-4)
    assert metrics["recall_5cm_5deg"] == np.mean((position_m <= 0.05) & (rotation_deg <= 5))
    assert metrics["above_20cm"] == np.mean(position_m > 0.2)


def test_the_map_alone(measured, trained_with_map, unsure):
    result, _ = measured
    found = list(in_map(SparseMap.load(unsure), frames_of(trained_with_map)))
    errors = [error_of(each.position_m, Rotation.from_quat(np.roll(each.quaternion, -1)), true) for true, each in found]
    assert_sums_up(result["map"]["metrics"], errors)
    assert result["map"]["metrics"]["accepted"] == np.mean([each.is_accepted for _, each in found])
    assert result["map"]["sha256"] == hashlib.sha256(unsure.read_bytes()).hexdigest()
    assert result["map"]["mib"] == len(unsure.read_bytes()) / 2**20
    assert (result["map"]["key_frames"], result["map"]["width"], result["map"]["ransac_seed"]) == (30, 160, 0)
    assert result["map"]["metrics"]["query_cpu_ms"] > 0


def test_both_are_the_map_where_it_is_accepted_or_likelier_and_the_network_elsewhere(
    measured, trained_with_map, unsure
):
    result, out = measured
    network, both = rows_of(out / "predictions.csv"), rows_of(out / "predictions_both.csv")
    priors = [CameraPose(rotation.as_matrix(), position_m) for position_m, rotation in map(pose_of, network)]
    found = list(in_map(SparseMap.load(unsure), frames_of(trained_with_map), priors))
    errors = []
    for alone, row, (true, each) in zip(network, both, found, strict=True):
        position_m, rotation = pose_of(row)
        is_map = each.is_accepted or each.probability > 0.25  # this network does not say how sure it is
        if is_map:
            expected_m, expected = each.position_m, Rotation.from_quat(np.roll(each.quaternion, -1))
        else:
            expected_m, expected = pose_of(alone)
        assert row["source"] == ("map" if is_map else "network")
        np.testing.assert_allclose(position_m, expected_m, atol=1e-5)
        assert np.degrees((rotation.inv() * expected).magnitude()) < 1e-2
        errors.append(error_of(position_m, rotation, true))
    metrics = result["network_and_map"]["metrics"]
    assert_sums_up(metrics, errors)
    assert metrics["accepted"] == np.mean([each.is_accepted for _, each in found])
    assert 0 < metrics["accepted"] < 1
    assert metrics["covariance_90"] <= 1
    assert metrics["position_error_worst_m"] < result["metrics"]["position_error_worst_m"] + 1e-9
    tum = np.loadtxt(out / "predictions_both.tum")
    np.testing.assert_allclose(tum[:, 1:4], [pose_of(row)[0] for row in both], atol=1e-6)
    assert json.loads((out / "metrics.json").read_text())["network_and_map"] == result["network_and_map"]


def test_a_network_that_states_its_radii_is_weighed_by_them(trained_with_map, unsure, tmp_path, monkeypatch):
    """As a bundle weighs it: radii of a centimetre and a degree are surer than any pose that the map rejects."""
    checkpoint = Checkpoint.read(trained_with_map / "checkpoints/last.ckpt")
    stated = Uncertainty(*torch.tensor([[0.01], [1.0], [0.5]]).expand(3, len(frames_of(trained_with_map))))
    monkeypatch.setattr("mambaloc.evaluation.evaluate.uncertainty_of_test", lambda system, data: stated)
    measured = measure_map(unsure, checkpoint.data())
    result = evaluate_checkpoint(checkpoint, tmp_path, accelerator="cpu", beside=measured)
    sources = [row["source"] for row in rows_of(tmp_path / "predictions_both.csv")]
    assert sources.count("map") / len(sources) == result["network_and_map"]["metrics"]["accepted"]


def test_the_table_has_a_row_each(measured, capsys):
    result, _ = measured
    print_table([result, result])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines[:9])) <= 80
    labels = [line.split("  ")[0] for line in lines[3:]]
    assert labels[:6] == ["last (epoch 1)", "last and map"] * 2 + ["map", "median training pose"]
    both = result["network_and_map"]["metrics"]
    assert f"{both['position_error_m']:.3f} m" in lines[4]
    assert f"{both['position_error_worst_m']:.2f}m" in lines[4]
    assert any(line.startswith(f"map: {result['map']['metrics']['accepted']:.1%} of its poses") for line in lines)


def test_a_run_ends_with_all_rows(trained_with_map):
    evaluation = trained_with_map / "evaluation/last"
    result = json.loads((evaluation / "metrics.json").read_text())
    assert (
        result["map"]["sha256"] == hashlib.sha256((trained_with_map / "map/map.safetensors").read_bytes()).hexdigest()
    )
    assert result["network_and_map"]["metrics"]["position_error_m"] < 0.02 < result["metrics"]["position_error_m"]
    assert result["network_and_map"]["metrics"]["accepted"] == 1
    assert (evaluation / "predictions_both.csv").is_file()


def test_the_tool_takes_the_runs_map_or_another(trained_with_map, unsure, tmp_path, monkeypatch, capsys):
    for options, path in (([], trained_with_map / "map/map.safetensors"), (["--map", str(unsure)], unsure)):
        words = [str(trained_with_map / "checkpoints/last.ckpt"), "--out", str(tmp_path), "--accelerator", "cpu"]
        monkeypatch.setattr(sys, "argv", ["evaluate.py", *words, *options])
        runpy.run_path(str(TOOL), run_name="__main__")
        result = json.loads((tmp_path / "metrics.json").read_text())
        assert result["map"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert "predictions_both.csv" in capsys.readouterr().out


def test_a_damaged_map_is_refused_where_it_is_named(trained_with_map, tmp_path, monkeypatch, capsys):
    damaged = tmp_path / "map" / "map.safetensors"
    damaged.parent.mkdir()
    damaged.write_bytes(b"damaged")
    data = Checkpoint.read(trained_with_map / "checkpoints/last.ckpt").data()
    with pytest.warns(InputWarning, match=r"map\.safetensors: is damaged .* measured without the map"):
        assert measure_map_of_run(tmp_path, data) is None
    words = [str(trained_with_map / "checkpoints/last.ckpt"), "--out", str(tmp_path / "out"), "--map", str(damaged)]
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *words])
    with pytest.raises(SystemExit) as exit_:
        runpy.run_path(str(TOOL), run_name="__main__")
    assert exit_.value.code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_run_without_a_map_has_no_rows_of_one(trained, tmp_path):
    result = json.loads((trained / "evaluation/last/metrics.json").read_text())
    assert not {"map", "network_and_map"} & set(result)
    assert not (trained / "map").exists()
    assert not (trained / "evaluation/last/predictions_both.csv").exists()
    assert measure_map_of_run(trained, Checkpoint.read(trained / "checkpoints/last.ckpt").data()) is None


def test_frames_without_a_pose_are_null_in_json(trained_with_map, tmp_path, monkeypatch):
    checkpoint = Checkpoint.read(trained_with_map / "checkpoints/last.ckpt")
    path = trained_with_map / "map/map.safetensors"
    black, intrinsics = np.zeros((120, 160, 3), np.uint8), SparseMap.load(path).intrinsics
    lost = MapLocalizer(SparseMap.load(path)).localize(black, intrinsics)
    assert np.isnan(lost.position_m).all()
    monkeypatch.setattr(MapLocalizer, "localize", lambda self, *_: lost)
    result = evaluate_checkpoint(checkpoint, tmp_path, accelerator="cpu", beside=measure_map(path, checkpoint.data()))
    read = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail)
    assert read["map"]["metrics"]["position_error_m"] is None
    assert read["map"]["metrics"]["without_pose"] == 1
    assert read["network_and_map"]["metrics"]["accepted"] == 0
    for name, value in result["metrics"].items():
        assert result["network_and_map"]["metrics"][name] == pytest.approx(value)
    assert [row["source"] for row in rows_of(tmp_path / "predictions_both.csv")] == ["network"] * 6
