"""Long trainings: growth is found where there is some, and a short one is watched from its first step to its last."""

import sys

import cv2
import lightning as L
import pytest
import soak
from lightning.pytorch.demos.boring_classes import BoringModel
from soak import ResourceWatch, Sample, draw_soak, growth, measure_soak, print_soak

from mambaloc.errors import InputError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="counts in /proc")


def sample(step, **changed):
    return Sample(
        **{"step": step, "seconds": step / 10, "private_mib": 500, "device_mib": 0, "files": 9, "threads": 4, **changed}
    )


def test_a_leak_is_found():
    """After a warm-up that takes 300 MiB, 2 MiB and one file are lost every hundred steps."""
    samples = [
        sample(step, private_mib=500 + 300 * min(1, step / 150) + step / 50, files=9 + step // 100)
        for step in range(10, 1001, 10)
    ]
    start, slope = growth(samples, "private_mib")
    assert start == pytest.approx(804 + 0.6, abs=1)
    assert slope == pytest.approx(20)
    assert growth(samples, "files")[1] == pytest.approx(10, rel=0.05)
    assert growth(samples, "threads") == (4, pytest.approx(0, abs=1e-9))


def check_samples(samples, steps):
    assert [each.step for each in samples] == steps
    assert all(each.private_mib > 50 and each.files > 2 and each.threads > 0 for each in samples)


def test_a_training_is_watched(tmp_path, capsys):
    path = tmp_path / "samples.jsonl"
    watch = ResourceWatch(str(path), every_n_steps=2)
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "accelerator": "cpu"}
    L.Trainer(max_steps=40, limit_val_batches=0, callbacks=[watch], **quiet).fit(BoringModel())
    samples = soak.read_samples(path)
    check_samples(samples, list(range(2, 41, 2)))
    print_soak(samples, "a machine")
    said = capsys.readouterr().out
    assert "open files" in said
    assert "GPU" not in said
    draw_soak(samples, tmp_path / "soak.png", "boring, 40 steps")
    assert cv2.imread(str(tmp_path / "soak.png")) is not None


@pytest.mark.nightly
@pytest.mark.slow
def test_a_recipe_from_a_shell(tiny_recipe, tmp_path, tool, capsys):
    """A training in a process of its own, to its end and with its mistakes; the tests beside guard each by itself."""
    out = tmp_path / "out"
    tool("benchmarks/soak", tiny_recipe, "--steps", 40, "--out", out)
    assert "open files" in capsys.readouterr().out
    check_samples(soak.read_samples(out / "samples.jsonl"), list(range(1, 41)))
    assert (out / "run/checkpoints/last.ckpt").is_file()
    assert cv2.imread(str(out / "soak.png")) is not None
    tiny_recipe.write_text("model: [")
    with pytest.raises(InputError, match=r"tiny\.yaml: its training ended with 2 \(.*tiny\.yaml.*\); see .*train\.log"):
        measure_soak([tiny_recipe], 40, tmp_path / "other")


def test_wrong_uses(tmp_path, tiny_recipe, monkeypatch):
    with pytest.raises(InputError, match=r"none\.yaml: no such recipe"):
        measure_soak([tmp_path / "none.yaml"], 40, tmp_path / "out")
    with pytest.raises(InputError, match="--steps 0: give 10 or more"):
        measure_soak([tiny_recipe], 0, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(soak, "_TRAIN", "import sys; sys.exit(f'{sys.argv[1]} is wrong')")
    with pytest.raises(InputError, match=r"tiny\.yaml: its training ended with 1 \(.*tiny\.yaml.*\); see .*train\.log"):
        measure_soak([tiny_recipe], 40, tmp_path / "out")
    with pytest.raises(InputError, match="out: already exists; choose another folder with --out"):
        measure_soak([tiny_recipe], 40, tmp_path / "out")
