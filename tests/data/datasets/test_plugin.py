"""A dataset of another package, named by its entry point."""

import pytest

from mambaloc.data import DATASETS, PoseDataModule
from mambaloc.errors import InputError

CODE = """
from pathlib import Path
from mambaloc.data.datasets.dataset import Dataset
from mambaloc.data.datasets.seven_scenes import read_split

DATASET = Dataset("halls", read_split, {}, Path("halls"))
OTHER = "no dataset"
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    about = tmp_path / "halls-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: halls\nVersion: 1.0\n")
    names = "halls = halls_of_a_package:DATASET\nrooms = halls_of_a_package:OTHER\n"
    (about / "entry_points.txt").write_text(f"[mambaloc.datasets]\n{names}")
    (tmp_path / "halls_of_a_package.py").write_text(CODE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(DATASETS, "halls", raising=False)
    yield
    DATASETS.pop("halls", None)


def test_its_frames_are_read(package, den):
    data = PoseDataModule("halls", str(den), "den", image_size=64, short_side=72)
    data.setup("fit")
    assert len(data.frames("train")) == len(PoseDataModule("7scenes", str(den), "den").chosen_training_frames())


def test_an_entry_point_that_gives_no_dataset_is_refused(package, den):
    with pytest.raises(InputError, match=r"data.dataset 'rooms': its package gives no Dataset of that name"):
        PoseDataModule("rooms", str(den), "den").setup("fit")


def test_a_near_miss_names_it(package, den):
    with pytest.raises(InputError, match=r"no such dataset. Did you mean halls\?"):
        PoseDataModule("hals", str(den), "den").setup("fit")
