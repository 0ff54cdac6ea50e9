"""How well systems know their own errors: against SciPy, by hand, and the whole of it on a tiny scene."""

import json

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import mannwhitneyu, spearmanr
from uncertainty_methods import (
    LEVELS,
    change_by_rejection,
    measure_certainty,
    ood_auroc,
    pose_spread,
    rank_correlation,
)
from uncertainty_report import print_certainty, write_certainty

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.geometry import canonical
from mambaloc.models import create_model
from mambaloc.types import PosePrediction


def test_figures_against_scipy():
    generator = np.random.default_rng(0)
    score, error = generator.normal(size=(2, 60)).round(1)  # with ties
    elsewhere = generator.normal(0.7, size=40).round(1)
    tensors = [torch.from_numpy(each) for each in (score, error, elsewhere)]
    assert rank_correlation(*tensors[:2]) == pytest.approx(spearmanr(score, error).statistic, abs=1e-6)
    expected = mannwhitneyu(elsewhere, score).statistic / (60 * 40)
    assert ood_auroc(tensors[0], tensors[2]) == pytest.approx(expected, abs=1e-6)


def test_rejection_by_hand():
    error = torch.tensor([1.0, 2, 3, 4, 10])
    assert change_by_rejection(error, error) == pytest.approx(2.5 / 3 - 1)
    assert change_by_rejection(-error, error) == pytest.approx(3.5 / 3 - 1)
    assert change_by_rejection(error, error, rejected=0.6) == pytest.approx(1.5 / 3 - 1)


def test_spreads_by_hand():
    """Two poses 6 m and 20 degrees apart are 3 m and 10 degrees from their mean, whatever the quaternions' signs."""
    turns = Rotation.from_euler("z", [[170], [190]], degrees=True).as_quat()[:, [3, 0, 1, 2]]
    poses = [
        PosePrediction(torch.tensor([[x, 1.0, 1.0]]), canonical(torch.from_numpy(turn[None]).float()))
        for x, turn in zip((0.0, 6.0), turns, strict=True)
    ]
    metres, degrees = pose_spread(poses)
    assert metres.item() == pytest.approx(3)
    assert degrees.item() == pytest.approx(10, abs=1e-3)


@pytest.fixture(scope="module")
def systems(scenes):
    """Two systems as they start, which say what they would be trained on."""
    small = {"dim": 16, "heads": 2, "encoder_layers": 1, "feedforward": 16, "head_hidden": 16}
    found = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        data = PoseDataModule("7scenes", str(scenes), "heads", 32, 36, validation="sequences", batch_size=4)
        data.setup("fit")
        system = create_model("mambaloc", backbone="test_efficientnet", image_size=32, **small)
        system.provenance = {"data": data.describe()}
        found.append((system, data))
    return found


@pytest.fixture
def elsewhere(tmp_path):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    for number, size in enumerate([(90, 60, 3), (60, 90, 3), (72, 96, 3)]):
        noise = np.random.default_rng(number).integers(0, 256, size, dtype=np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), noise)
    return folder


def test_all_of_it_on_a_tiny_scene(systems, elsewhere, tmp_path, capsys):
    found = measure_certainty(dict(zip("ab", systems, strict=True)), elsewhere)
    for each in found:
        assert [way.name for way in each.ways] == ["training images", "dropout", "shifted crops", "ensemble of 2"]
        assert all((len(way.position), len(way.rotation), len(way.elsewhere)) == (8, 8, 3) for way in each.ways)
        assert all(way.position.std() > 0 for way in each.ways)
        assert each.held_out_frames == 12
        assert tuple(each.coverage) == LEVELS
        for radii in zip(*each.radii.values(), strict=True):
            assert list(radii) == sorted(radii)  # a larger share asks for larger radii
    same, other = (each.ways[-1].position for each in found)
    assert torch.equal(same, other)  # an ensemble is one, whoever is asked

    write_certainty(found, tmp_path / "out", "a machine")
    told = json.loads((tmp_path / "out/uncertainty.json").read_text())
    assert told["where"] == "mambaloc on 7scenes/heads, test"
    assert told["compared"]["dropout"]["passes"] == 8
    assert told["checkpoints"][1]["coverage"]["0.9"] == list(found[1].coverage[0.9])
    assert cv2.imread(str(tmp_path / "out/uncertainty.png")).shape[0] > 400
    print_certainty(found, "a machine")
    said = capsys.readouterr().out
    assert "ensemble of 2" in said
    assert "of 3 images of another place" in said


def test_one_checkpoint_and_no_other_place(systems, tmp_path, capsys):
    found = measure_certainty({"a": systems[0]})
    assert len(found[0].ways) == 3
    write_certainty(found, tmp_path, "a machine")
    assert json.loads((tmp_path / "uncertainty.json").read_text())["checkpoints"][0]["unfamiliar_elsewhere"] is None
    print_certainty(found, "a machine")
    assert "another place" not in capsys.readouterr().out
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match=r"--elsewhere .*none: contains no \.png"):
        measure_certainty({"a": systems[0]}, tmp_path / "none")


def test_a_checkpoint_from_a_shell(trained, tmp_path, tool, capsys):
    tool("benchmarks/uncertainty", trained / "checkpoints/last.ckpt", "--out", tmp_path / "out")
    assert "shifted crops" in capsys.readouterr().out
    assert (tmp_path / "out/uncertainty.json").is_file()
