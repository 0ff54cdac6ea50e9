"""A folder with what the pages' commands name: a run, a scene, images and a video, by the pages' own names."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from doc_blocks import ROOT

from mambaloc import commands


@pytest.fixture(scope="session")
def mambaloc():
    """Run ``mambaloc WORDS`` in this process, which has imported its modules; a refusal raises SystemExit."""

    def run(*words: str) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.argv", ["mambaloc", *words])
            commands.main()

    return run


@pytest.fixture
def workspace(tmp_path, monkeypatch, trained_student, scenes, den, bundles_for_lenses):
    """The working directory of a page's commands: the checkout's recipes and tools, and what readers have made."""
    for name in ("recipes", "tools"):
        (tmp_path / name).symlink_to(ROOT / name)
    shutil.copytree(trained_student, tmp_path / "RUN")
    shutil.copyfile(tmp_path / "RUN/checkpoints/last.ckpt", tmp_path / "RUN/checkpoints/best.ckpt")
    bundle = bundles_for_lenses / "pictures"
    shutil.copyfile(bundle / "model.onnx", tmp_path / "RUN/model.onnx")
    for folder in ("RUN/bundle", "phone"):
        shutil.copytree(bundle, tmp_path / folder)
    for run in ("runs/my_scene/TIME", "runs/instant/TIME", "runs/sweeps/table/runs/KEY"):
        (tmp_path / run).parent.mkdir(parents=True)
        (tmp_path / run).symlink_to(tmp_path / "RUN")
    (tmp_path / "CAPTURE").symlink_to(den / "den")
    images = sorted((scenes / "heads/seq-03").glob("*.color.*"))
    for name in ("photo.jpg", "image.jpg", "image.png"):
        cv2.imwrite(str(tmp_path / name), cv2.imread(str(images[0])))
    _write_video(tmp_path / "film.mp4", images)
    (tmp_path / "VIDEO_OR_FOLDER_OR_CAMERA").symlink_to(tmp_path / "film.mp4")
    (tmp_path / "RECIPE.yaml").write_text(yaml.safe_dump({"model": {"class_path": "LitStudent"}}))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _write_video(path: Path, images: list[Path]) -> None:
    first = cv2.imread(str(images[0]))
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, first.shape[1::-1])
    for image in images:
        writer.write(np.ascontiguousarray(cv2.imread(str(image))))
    writer.release()
