"""What comes with the package does what its manifest says."""

from pathlib import Path

import pytest

import mambaloc
from mambaloc.data import PoseDataModule
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.metrics import summarize
from mambaloc.models.registry import model_class
from mambaloc.zoo import Manifest, list_released

ZOO = Path(__file__).parents[2] / "zoo"


NAMES = sorted(path.name for path in ZOO.iterdir() if path.is_dir())
SHOWN = ("denseloc.embedded_room", "student.embedded_room")  # by the page, and where nothing is named


def test_every_system_is_released_and_small():
    ours = [name for name in mambaloc.list_models() if model_class(name).__module__.startswith("mambaloc.")]
    assert [f"{system}.embedded_room" for system in ours] == NAMES
    assert set(NAMES) <= set(list_released())
    for name in NAMES:
        assert sum(file.stat().st_size for file in (ZOO / name).iterdir()) < 8e6


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in SHOWN else pytest.mark.nightly) for n in NAMES]
)
def test_their_figures_are_found_again(name):
    system, manifest = mambaloc.load(name), Manifest.read(ZOO / name)
    (result,) = manifest.results
    assert result.data == manifest.scene == "embedded/room"
    data = PoseDataModule("embedded", image_size=system.image_size, short_side=manifest.short_side)
    table = localize_test_frames(system, data, "cpu")
    assert len(table.index) == result.n
    found = summarize(table)
    assert found["position_error_m"] == pytest.approx(result.position_error_m, abs=2e-3)
    assert found["rotation_error_deg"] == pytest.approx(result.rotation_error_deg, abs=0.05)
