"""Cases of images, texts and folders that are read, and of runs: what happens must be what each README says."""

import csv
import json
import shlex
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from reading_truth import CASES, assert_true, needs_cases, scene_poses, true_poses
from scipy.spatial.transform import Rotation

from mambaloc.cli import main
from mambaloc.data.datasets.seven_scenes import read_split
from mambaloc.data.frames import BadFrames
from mambaloc.importing.importer import import_scene
from mambaloc.importing.registry import read_capture
from mambaloc.runtime.sources import frames_of

pytestmark = needs_cases


@pytest.fixture
def no_camera(monkeypatch):
    """A test that opens a video or a camera fails."""
    monkeypatch.setattr(cv2, "VideoCapture", lambda what: pytest.fail(f"{what} was opened as a video or a camera"))


def test_exif_upside_down(tmp_path):
    capture = import_scene(CASES / "exif-upside-down/capture", tmp_path / "scene").capture
    assert len(capture.images) == 24
    assert_true(scene_poses(tmp_path / "scene"), true_poses(CASES / "exif-upside-down/truth.txt"))
    assert "as COLMAP reads them; 12 of 24" in capture.choices["pixels"]
    for image in capture.images:
        with Image.open(tmp_path / "scene" / image.relative_to(image.parents[2])) as copy:
            assert copy.getexif().get(0x0112) is None
            stored = Image.open(CASES / "exif-upside-down/capture/images" / image.name)  # Pillow turns nothing here
            np.testing.assert_array_equal(np.asarray(copy), np.asarray(stored))


def test_phone_heic_is_refused_by_name(no_camera, tmp_path, monkeypatch, refused):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    photo = CASES / "phone-heic/photo.heic"
    (tmp_path / "photos").mkdir()
    frames = []
    for number in range(3):
        shutil.copy(photo, tmp_path / f"photos/{number}.heic")
        frames.append({"file_path": f"photos/{number}.heic", "transform_matrix": np.eye(4).tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 400, "frames": frames}))
    renamed = shutil.copy(photo, tmp_path / "photo.mov")  # a video by its name
    for source in (photo, tmp_path / "photos", renamed):
        refused(lambda source: list(frames_of(source)[0]), source, "is HEIC", "mambaloc[heic]", "JPEG")
    refused(lambda source: read_capture(source), tmp_path, "photos/0.heic", "is HEIC", "mambaloc[heic]")


def test_phone_heic_is_read_whole_with_the_extra(no_camera):
    pytest.importorskip("pillow_heif", reason="needs the extra heic")
    (frame,) = frames_of(CASES / "phone-heic/photo.heic")[0]
    assert frame.image.shape == (384, 512, 3)
    assert frame.image[-128:, -128:].std() > 5  # the last tile is there, too


def test_sixteen_bit(tmp_path):
    source = CASES / "sixteen-bit/capture"
    capture = import_scene(source, tmp_path / "scene").capture
    assert_true(scene_poses(tmp_path / "scene"), true_poses(CASES / "sixteen-bit/truth.txt"))
    counts = np.stack([np.asarray(Image.open(source / "images" / image.name)) for image in capture.images])
    seen = np.stack([np.asarray(Image.open(tmp_path / "scene/images/images" / image.name)) for image in capture.images])
    assert seen.shape == (24, 60, 80, 3)
    assert seen.dtype == np.uint8
    black, white = map(int, capture.choices["16 bits"].rpartition(" ")[2].split(","))
    expected = np.clip(np.rint((counts.astype(float) - black) * 255 / (white - black)), 0, 255)
    np.testing.assert_array_equal(seen, np.repeat(expected[..., None], 3, axis=-1))  # one line for all images
    assert len(np.unique(seen)) > 200
    assert np.isin(seen, (0, 255)).mean() < 0.01


def test_sixteen_bit_queries_need_the_counts_of_their_scene(refused):
    folder = CASES / "sixteen-bit/capture/images"
    refused(lambda source: list(frames_of(source)[0]), folder, "img_000.png", "16 bits", "--counts")
    frames = list(frames_of(folder, counts=(7672, 8193))[0])
    assert len(np.unique(frames[0].image)) > 100


def test_numbered_folder(no_camera, monkeypatch):
    monkeypatch.chdir(CASES / "numbered-folder")
    frames, count = frames_of("000")
    assert (count, [frame.name for frame in frames]) == (2, ["0001.jpg", "0002.jpg"])


def test_unpadded_folder(no_camera):
    frames, _ = frames_of(CASES / "unpadded-folder/frames")
    assert [(frame.name, round(30 * frame.time_s)) for frame in frames] == [(f"{at}.jpg", at) for at in range(24)]


@pytest.mark.parametrize("name", ["bom", "utf16", "pose-bom"])
@pytest.mark.parametrize(("split", "sequence"), [("train", "seq-01"), ("test", "seq-02")])
def test_windows_text(name, split, sequence):
    folder = CASES / "windows-text" / name
    found = read_split(folder, split, BadFrames())
    texts = [path.read_bytes().removeprefix(b"\xef\xbb\xbf") for path in sorted((folder / sequence).glob("*.pose.txt"))]
    expected = np.array([[float(word) for word in text.decode("ascii").split()] for text in texts]).reshape(-1, 4, 4)
    assert [path.name for path in found.image_paths] == [f"frame-{at:06d}.color.jpg" for at in range(3)]
    np.testing.assert_array_equal(found.position_m, expected[:, :3, 3])
    matrices = Rotation.from_quat(found.quaternion[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(matrices, expected[:, :3, :3], atol=1e-5)  # six decimals in the file


@pytest.mark.slow
def test_trainer_options(tiny_recipe, tmp_path, capsys):
    """Each of the commands, on a small recipe of one device."""
    commands = [shlex.split(line) for line in (CASES / "trainer-options/commands.sh").read_text().splitlines() if line]
    assert commands
    for command in commands:
        options = command[command.index("recipes/quickstart.yaml") + 1 :]
        with pytest.raises(SystemExit) as exit_:
            main([str(tiny_recipe), *options, "--trainer.default_root_dir", str(tmp_path)])
        assert exit_.value.code == 2
        error = capsys.readouterr().err.strip()
        assert options[0].removeprefix("--") in error
        assert len(error.splitlines()) == 1, error


def assert_best_of_all(run):
    """Check that ``best.ckpt`` is of the epoch that the logs call the best, and is known as that."""
    losses = {}
    for log in sorted(run.glob("metrics/*/metrics.csv")):
        with log.open() as file:
            losses |= {int(row["epoch"]): float(row["val/loss"]) for row in csv.DictReader(file) if row.get("val/loss")}
    assert set(losses) == {0, 1, 2, 3}
    best = min(losses, key=losses.__getitem__)
    assert best < 2  # else nothing would be shown
    stored = {name: torch.load(run / f"checkpoints/{name}.ckpt", weights_only=True) for name in ("best", "last")}
    assert (stored["best"]["epoch"], stored["last"]["epoch"]) == (best, 3)
    states = stored["last"]["callbacks"].items()
    (state,) = (each for key, each in states if key.startswith("ModelCheckpoint") and "val/loss" in key)
    assert float(state["best_model_score"]) == pytest.approx(losses[best])
    assert Path(state["best_model_path"]).name == "best.ckpt"
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]


@pytest.mark.slow
def test_moved_run(tiny_recipe, tmp_path, monkeypatch):
    """A resumed run ends with the best epoch of all, wherever its folder is; trains six epochs in all, some 20 s."""
    monkeypatch.chdir(tmp_path)
    rising = ["--model.lr", "0.05", "--model.lr_step_epochs", "50"]  # so large that an early epoch stays the best
    command = [str(tiny_recipe), *rising, "--best_checkpoint.every_n_epochs", "1"]
    command += ["--last_checkpoint.every_n_epochs", "1", "--trainer.enable_progress_bar", "false"]
    main([*command, "--trainer.max_epochs", "3", "--trainer.default_root_dir", "run"])
    for name in ("moved", "linked", "entered"):
        shutil.copytree("run", name)
    shutil.rmtree("run")
    Path("link").symlink_to("linked")
    resume = [*command, "--trainer.max_epochs", "4", "--ckpt_path"]
    main([*resume, str(tmp_path / "moved/checkpoints/last.ckpt")])
    main([*resume, "link/checkpoints/last.ckpt"])
    monkeypatch.chdir(tmp_path / "entered/checkpoints")
    main([*resume, "last.ckpt"])
    for name in ("moved", "linked", "entered"):
        assert_best_of_all(tmp_path / name)
