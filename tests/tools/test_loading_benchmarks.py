"""What loading costs: from the cache against decoding, and scenes whole."""

import subprocess
import sys
from pathlib import Path

import loading
import pytest
import scenes as scenes_benchmark
from loading import LoadingRates, measure_loading
from scenes import measure_scenes, print_scenes

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError

SCRIPT = Path(__file__).parents[2] / "tools/benchmarks/scenes.py"


def test_loading_is_timed_both_ways(scenes):
    data = PoseDataModule("7scenes", str(scenes), "heads", image_size=32, short_side=36, batch_size=4)
    rates = measure_loading(data, batches=2, repetitions=3)
    assert len(rates.cached) == len(rates.decoded) == 3
    assert min(rates.cached + rates.decoded) > 0


def test_ratio_is_of_medians(capsys):
    rates = LoadingRates(cached=[10.0, 30.0, 1000.0], decoded=[1.0, 3.0, 4.0])
    assert rates.ratio == 10
    loading.print_loading(rates, "a machine")
    assert "ratio 10.0   a machine" in capsys.readouterr().out


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache of this test's own."""
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_scenes_are_loaded_whole(scenes, cache, capsys, monkeypatch):
    monkeypatch.setattr(scenes_benchmark, "in_a_process", lambda measure, *args: measure(*args))
    (found,) = measure_scenes("7scenes", scenes, ["heads"], short_side=36)
    data = PoseDataModule("7scenes", str(scenes), "heads", short_side=36, image_size=32, validation="none")
    data.setup("fit")
    data.setup("test")
    assert found.counts == (len(data.frames("train")), len(data.frames("test")))
    height, width = data.train_dataloader().dataset.images.shape[-2:]
    assert found.cache_bytes == pytest.approx(sum(found.counts) * 3 * height * width, rel=0.1)
    assert found.image_bytes == sum(p.stat().st_size for p in scenes.glob("heads/*/*.color.*"))
    assert found.rendered
    assert min(found.read_s, found.build_s, found.open_s) > 0
    assert [path.name for path in cache.iterdir()] == ["frames"]  # that of this test
    print_scenes([found], "a machine")
    said = capsys.readouterr().out
    assert "of another size than the benchmark's: heads" in said
    assert "rendered, no real images: heads" in said


def test_wrong_scenes(tmp_path):
    with pytest.raises(InputError, match="contains none of chess"):
        measure_scenes("7scenes", tmp_path, [])
    with pytest.raises(InputError, match="--dataset nowhere"):
        measure_scenes("nowhere", tmp_path, [])


@pytest.mark.nightly
@pytest.mark.slow
def test_both_from_a_shell(scenes, cache, tool, capsys):
    """In processes of their own, which find what they run in the script; the tests above guard what is measured."""
    args = [str(SCRIPT), str(scenes), "heads", "--short-side", "36"]
    said = subprocess.run([sys.executable, *args], capture_output=True, text=True, check=True).stdout
    assert "rendered, no real images: heads" in said
    tool("benchmarks/loading", "--dataset", "7scenes", "--root", scenes)
    assert "ratio" in capsys.readouterr().out
