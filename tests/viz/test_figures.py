"""Every kind of figure of real, tiny trainings, and the tool used wrongly."""

import re
import runpy
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mambaloc.errors import InputError
from mambaloc.evaluation.figures import FIGURES
from mambaloc.metrics import PoseErrors
from mambaloc.types import PoseBatch, PosePrediction
from mambaloc.viz.scene_page import write_scene_page
from mambaloc.viz.top_view import draw_top_view, horizontal_axes
from mambaloc.viz.trajectory import box_around, draw_trajectory

TOOLS = Path(__file__).parents[2] / "tools"


def tool(name, *words):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(TOOLS / f"{name}.py"), run_name="__main__")


@pytest.fixture(scope="module")
def checkpoints(trained, tmp_path_factory):
    """Of a MambaLoc, and of one without GIS that was validated on the test frames."""
    folder = tmp_path_factory.mktemp("without_gis")
    words = ["--model.gis", "none", "--data.validation", "test_set", "--best_checkpoint.save_top_k", 0]
    tool("train", trained.parent / "recipe.yaml", *words, "--trainer.default_root_dir", folder)
    return [run / "checkpoints/last.ckpt" for run in (trained, folder)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", FIGURES)
def test_every_kind_is_drawn(kind, checkpoints, tmp_path, capsys):
    tool("visualize", kind, *checkpoints, "--out", tmp_path, "--frames", 2)
    written = [Path(line) for line in capsys.readouterr().out.splitlines() if line.startswith(str(tmp_path))]
    assert sorted(written) == sorted(tmp_path.iterdir())
    pictures = [cv2.imread(str(path)) for path in written if path.suffix == ".png"]
    assert len(pictures) == (2 if kind == "trajectory" else 1)
    assert all(min(picture.shape[:2]) > 200 and picture.std() > 5 for picture in pictures)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["portrait", "CHECKPOINT"], "portrait"),
        (["heatmaps", "nothing.ckpt"], "nothing.ckpt: no such checkpoint"),
        (["heatmaps", "CHECKPOINT", "--frames", "0"], "--frames 0: must be 1 to"),
        (["features", "CHECKPOINT", "--frames", "9"], "there are 8 test frames"),
        (["heatmaps", "CHECKPOINT", "OTHER"], "draw systems of one image size together"),
        (["heatmaps", "CHECKPOINT", "ELSEWHERE"], "has other test frames"),
        (["time", "STUDENT"], "was not validated"),
        (["cumulative", "CHECKPOINT", "--out", "FILE"], "cannot be written"),
    ],
)
def test_visualize_used_wrong(words, rule, trained, trained_student, scenes, tmp_path, capsys):
    (tmp_path / "file").touch()
    checkpoint, student = (run / "checkpoints/last.ckpt" for run in (trained, trained_student))
    named = {"CHECKPOINT": checkpoint, "STUDENT": student, "FILE": tmp_path / "file"}
    if "OTHER" in words:
        named["OTHER"] = enlarged(student, tmp_path)
    if "ELSEWHERE" in words:
        named["ELSEWHERE"] = moved(checkpoint, scenes, tmp_path)
    with pytest.raises(SystemExit) as exit_:
        tool("visualize", *(named.get(word, word) for word in words))
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert rule in error
    assert len(error.strip().splitlines()) == 1


def moved(checkpoint, scenes, folder):
    """The same training, as if of a scene that tests on another sequence."""
    elsewhere = shutil.copytree(scenes / "heads", folder / "scenes/heads")
    (elsewhere / "TestSplit.txt").write_text("sequence2\n")
    stored = torch.load(checkpoint, weights_only=True)
    stored["datamodule_hyper_parameters"]["root"] = str(folder / "scenes")
    torch.save(stored, folder / "moved.ckpt")
    return folder / "moved.ckpt"


def enlarged(checkpoint, folder):
    """The same training, as if of larger images, of which a student's weights know nothing."""
    stored = torch.load(checkpoint, weights_only=True)
    for part in ("hyper_parameters", "datamodule_hyper_parameters"):
        stored[part]["image_size"] = 48
    stored["datamodule_hyper_parameters"]["short_side"] = 72
    torch.save(stored, folder / "enlarged.ckpt")
    return folder / "enlarged.ckpt"


@pytest.fixture
def table():
    """Two outdoor sequences whose y points up, predicted a metre off."""
    rng = np.random.default_rng(0)
    true_m = torch.from_numpy(rng.normal(0, (20, 0.3, 40), (12, 3))).float()
    quaternion = torch.tensor([[1.0, 0, 0, 0]]).expand(12, -1)
    errors = PoseErrors()
    batch = PoseBatch(torch.zeros(12, 3, 2, 2), true_m, quaternion, torch.arange(12))
    errors.update(PosePrediction(true_m + torch.tensor([1.0, 0, 0]), quaternion), batch)
    return errors.table()


def test_the_top_view_leaves_out_the_axis_that_points_up(table, tmp_path):
    assert horizontal_axes(table.true_position_m.numpy()) == (0, 2)
    assert horizontal_axes(table.true_position_m.numpy()[:, [0, 2, 1]]) == (0, 1)
    draw_top_view(table, ["seq1"] * 6 + ["seq2"] * 6, tmp_path / "view.png", "a place")
    picture = cv2.imread(str(tmp_path / "view.png"))
    blue, green, red = (picture[..., channel].astype(int) for channel in range(3))
    assert ((red - green > 100) & (red - blue > 100)).sum() > 100  # predictions
    assert (picture.max(-1) < 40).sum() > 100  # the true path


def test_the_page_names_every_frame_and_fetches_nothing(table, tmp_path):
    names = [f"seq1/<frame>{i:03d}.png" for i in range(12)]
    write_scene_page(table, ["seq1"] * 6 + ["seq2"] * 6, names, tmp_path / "page.html", "a <place>\nrendered")
    page = (tmp_path / "page.html").read_text()
    assert all(f"frame\\u003e{i:03d}.png" in page or f"frame&gt;{i:03d}.png" in page for i in range(12))
    assert "<h1>a &lt;place&gt;</h1>" in page
    assert "median 1.000 m, 0.00°; mean 1.000 m, 0.00°; 12 frames" in page
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=", page)
    assert '"showSendToCloud": false' in page  # plotly 7 would offer to upload the chart


@pytest.mark.parametrize("without", [[1, 5], range(12)])
def test_frames_without_a_pose_are_left_out_of_every_figure(table, tmp_path, without):
    rows = torch.isin(torch.arange(12), torch.tensor(list(without)))
    lost = replace(
        table,
        predicted_position_m=table.predicted_position_m.masked_fill(rows[:, None], torch.nan),
        position_error_m=table.position_error_m.masked_fill(rows, torch.inf),
        rotation_error_deg=table.rotation_error_deg.masked_fill(rows, torch.inf),
    )
    draw_trajectory(lost, ["seq1"] * 12, tmp_path / "trajectory.png", "a place")
    draw_top_view(lost, ["seq1"] * 12, tmp_path / "view.png", "a place")
    write_scene_page(lost, ["seq1"] * 12, [f"{i}" for i in range(12)], tmp_path / "page.html", "a place")
    assert all(cv2.imread(str(tmp_path / name)).std() > 5 for name in ("trajectory.png", "view.png"))
    assert np.isfinite(box_around(lost)).all()
    assert (box_around(lost)[:, 0] <= lost.true_position_m.numpy().min(axis=0) + 1e-4).all()


def test_a_page_without_plotly_names_the_extra(table, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    with pytest.raises(InputError, match=r"pip install 'mambaloc\[viz\]'"):
        write_scene_page(table, ["seq1"] * 12, ["frame"] * 12, tmp_path / "page.html", "a place")
    assert not list(tmp_path.iterdir())
