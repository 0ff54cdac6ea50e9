"""From a training run to an app and the zoo, by the tools alone; and each tool used wrongly."""

import json
import runpy
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import timm
import torch
from safetensors.torch import save_file

from mambaloc.rendering import default_intrinsics, embedded_frames, embedded_room, render

TOOLS = Path(__file__).parents[2] / "tools"

pytestmark = pytest.mark.slow


def tool(name, *words):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(TOOLS / f"{name}.py"), run_name="__main__")


def test_a_run_is_exported_verified_and_localizes(trained_student, scenes, tmp_path, capsys):
    run = shutil.copytree(trained_student, tmp_path / "run")
    tool("export", run / "checkpoints/last.ckpt", "--to", "onnx,fp16", "--raw-input")
    bundle = run / "bundle"
    capsys.readouterr()
    tool("verify_bundle", bundle)
    said = capsys.readouterr().out
    assert said.count("within bounds") == 2
    tool("localize", bundle, scenes / "heads/seq-03", "--out", tmp_path / "poses.tum")
    assert "8 poses" in capsys.readouterr().out
    poses = np.loadtxt(tmp_path / "poses.tum")
    assert poses.shape == (8, 8)
    np.testing.assert_allclose(poses[:, 0], np.arange(8) / 30, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(poses[:, 4:], axis=1), 1, atol=1e-5)
    tool("localize", bundle, scenes / "heads/seq-03", "--filter", "smooth", "--out", tmp_path / "smooth.tum")
    assert "8 poses (0 outliers)" in capsys.readouterr().out
    assert np.loadtxt(tmp_path / "smooth.tum").shape == (8, 8)


def test_a_released_model_is_exported_by_name(tmp_path, capsys):
    tool("export", "student.embedded_room", "--to", "int8", "--out", tmp_path / "bundle")
    assert "int8 (all layers): median" in capsys.readouterr().out
    written = {path.name for path in (tmp_path / "bundle").glob("m*")}
    assert written == {"model.int8.onnx", "map.safetensors", "map_localiser.hpp"}


def test_a_picture_alone_is_localized_in_the_embedded_room(tmp_path, capsys):
    tool("localize", embedded_shot(tmp_path), "--out", tmp_path / "poses.tum")
    assert "1 poses (1 from the map, 0 from the network) in embedded/room" in capsys.readouterr().out
    (row,) = np.loadtxt(tmp_path / "poses.tum", ndmin=2)
    assert np.linalg.norm(row[1:4] - embedded_frames()[0].world_from_cam[:3, 3]) < 0.05


def embedded_shot(folder):
    rgb, _ = render(embedded_room(), default_intrinsics((320, 240)), embedded_frames()[0].world_from_cam, (320, 240))
    cv2.imwrite(str(folder / "shot.png"), rgb[..., ::-1])
    return folder / "shot.png"


def test_retrieval_is_measured_on_the_features_a_training_starts_from(trained_student, tmp_path, capsys):
    torch.manual_seed(0)
    save_file(timm.create_model("test_efficientnet", num_classes=0).state_dict(), tmp_path / "start.safetensors")
    weights = ("--model.backbone_weights", tmp_path / "start.safetensors")
    tool("train", trained_student / "recipe.yaml", *weights, "--trainer.default_root_dir", tmp_path / "run")
    tool("evaluate", tmp_path / "run/checkpoints/last.ckpt", "--retrieval", "--out", tmp_path / "out")
    assert "retrieval mean of 5" in capsys.readouterr().out
    references = json.loads((tmp_path / "out/metrics.json").read_text())["references"]
    said = {name: each["position_error_m"] for name, each in references.items()}
    assert list(said) == ["median_training_pose", "nearest_training_pose", "retrieval", "retrieval_mean_of_5"]
    assert said["nearest_training_pose"] <= said["retrieval"]


def test_a_checkpoint_is_published(trained_student, tmp_path, capsys):
    tool("publish", trained_student / "checkpoints/last.ckpt", "--tag", "heads", "--zoo", tmp_path)
    assert str(tmp_path / "student.heads") in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "student.heads").iterdir()} == {
        "manifest.yaml", "weights.safetensors", "README.md",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("export", ["nothing.ckpt"], "nothing.ckpt: no such checkpoint"),
        (
            "export",
            ["{run}/checkpoints/last.ckpt", "--to", "onnx,tflite"],
            "'tflite' is not one of onnx, fp16, int8, ort",
        ),
        ("export", ["student.embedded_rom"], "Did you mean student.embedded_room?"),
        ("export", ["{run}/checkpoints/last.ckpt", "--out", "{run}"], "already exists"),
        ("evaluate", ["{run}/checkpoints/last.ckpt", "--retrieval"], "needs a backbone that started from pretrained"),
        ("verify_bundle", ["nothing"], "give a bundle's folder"),
        ("verify_bundle", ["{run}"], "give a bundle's folder"),
        ("localize", ["nothing.onnx", "0"], "nothing.onnx: no such model"),
        ("localize", ["{run}", "0"], "contains no model.onnx"),
        ("localize", ["student.embedded_rom", "0"], "Did you mean student.embedded_room?"),
        ("localize", ["{bundle}", "nothing.mp4"], "no such file, folder or camera"),
        ("publish", ["{run}/recipe.yaml", "--tag", "a"], "recipe.yaml"),
        ("publish", ["{run}/checkpoints/last.ckpt", "--tag", "A B"], "choose another"),
        ("publish", ["nothing.ckpt", "--tag", "a"], "no such checkpoint"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(name, words, message, trained_student, bundle_of_pictures, capsys):
    with pytest.raises(SystemExit) as exit_:
        tool(name, *(word.format(run=trained_student, bundle=bundle_of_pictures) for word in words))
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1
