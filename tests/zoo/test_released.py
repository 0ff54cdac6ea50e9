"""What comes with the package does what its manifest says."""

from pathlib import Path

import pytest

import mambaloc
from mambaloc.data import PoseDataModule
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.metrics import summarize
from mambaloc.zoo import Manifest, list_released

ZOO = Path(__file__).parents[2] / "zoo"


NAMES = ["denseloc.embedded_room", "student.embedded_room"]


def test_they_are_small():
    shipped = sorted(path for path in ZOO.iterdir() if path.is_dir())
    assert [path.name for path in shipped] == NAMES
    assert set(NAMES) <= set(list_released())
    for folder in shipped:
        assert sum(file.stat().st_size for file in folder.iterdir()) < 8e6


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
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
