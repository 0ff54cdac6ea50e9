"""Several scenes in one data module: every batch has images of each, as the scene alone gives them.

Guess first: that Lightning's CombinedLoader tells its length before it is iterated (wrong: it raises, so the data
module counts an epoch's batches itself), and that it gives each part's sampler the epoch (right).
"""

import shutil

import lightning as L
import numpy as np
import pytest
import torch

from mambaloc.data import MultiSceneDataModule, PoseDataModule, build_data
from mambaloc.data.multi_scene import _shares, joined
from mambaloc.errors import InputError
from mambaloc.types import PoseBatch

SIZES = {"image_size": [32, 40], "short_side": 36, "validation": "block", "val_gap": 1}


@pytest.fixture(scope="module")
def two_scenes(scenes, tmp_path_factory):
    """Two scenes of one root, the second with half of the other's training frames."""
    root = tmp_path_factory.mktemp("two")
    for name in ("heads", "half"):
        shutil.copytree(scenes / "heads", root / name)
    (root / "half" / "TrainSplit.txt").write_text("sequence1\n")
    return root


@pytest.mark.parametrize(
    ("sizes", "batch_size", "shares"),
    [
        ([1, 1], 8, [4, 4]),
        ([1, 1, 1], 8, [3, 3, 2]),
        ([100, 1], 8, [7, 1]),
        ([300, 100], 8, [6, 2]),
        ([5, 9], 2, [1, 1]),
    ],
)
def test_a_batch_is_shared_out_by_size_with_an_image_of_each_at_least(sizes, batch_size, shares):
    assert _shares(sizes, batch_size) == shares


def test_by_size_the_larger_scene_gives_more_images(two_scenes):
    arguments = {**SIZES, "validation": "none", "root": str(two_scenes), "batch_size": 6}
    data = MultiSceneDataModule(["heads", "half"], scene_share="size", **arguments)
    assert [each.hparams["batch_size"] for each in data.each_scene()] == [4, 2]
    data = MultiSceneDataModule(["heads", "half"], **arguments)
    assert [each.hparams["batch_size"] for each in data.each_scene()] == [3, 3]


class Batches(L.LightningModule):
    """Keeps the batches that it is trained and validated on."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.trained, self.validated = [], []

    def training_step(self, batch, batch_idx):
        self.trained.append(batch)
        return self.weight * batch.image.mean()

    def validation_step(self, batch, batch_idx, dataloader_idx=0):
        self.validated.append((dataloader_idx, batch))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.0)


def fitted(data):
    model = Batches()
    options = {"accelerator": "cpu", "logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    L.Trainer(max_epochs=2, num_sanity_val_steps=0, enable_model_summary=False, **options).fit(model, datamodule=data)
    return model


@pytest.mark.parametrize("augmentation", ["crop", "rotation"])
def test_each_scene_is_seen_as_if_it_were_alone(two_scenes, augmentation):
    arguments = {**SIZES, "root": str(two_scenes), "augmentation": augmentation}
    together = fitted(MultiSceneDataModule(["heads", "half"], batch_size=8, **arguments))
    alone = fitted(PoseDataModule(scene="heads", batch_size=4, **arguments))
    assert len(together.trained) == len(alone.trained)
    for both, one in zip(together.trained, alone.trained, strict=True):
        mine = both.scene == 0
        assert mine.sum() == len(one.index)
        for name in ("image", "position_m", "quaternion", "intrinsics"):
            torch.testing.assert_close(getattr(both, name)[mine], getattr(one, name), rtol=0, atol=0)
        assert (both.index[mine] == 2 * one.index).all()  # apart from the other scene's, which are odd
    assert {index for index, _ in together.validated} == {0, 1}
    assert all((batch.scene == index).all() for index, batch in together.validated)


def test_points_and_holes_that_one_scene_lacks_are_none_in_a_joined_batch():
    def part(count, points, holes):
        image = torch.rand(count, 3, 4, 4)
        return PoseBatch(
            image, torch.zeros(count, 3), torch.ones(count, 4), torch.arange(count),
            points_m=torch.ones(count, points, 3) if points else None, intrinsics=torch.eye(3).expand(count, 3, 3),
            holes=torch.ones(count, 4, 4, dtype=torch.bool) if holes else None, scene=torch.zeros(count),
        )  # fmt: skip

    both = joined([part(2, 5, True), part(1, 0, False), part(1, 3, False)])
    assert both.points_m.isfinite().all(dim=-1).sum(dim=1).tolist() == [5, 5, 0, 3]
    assert both.holes.flatten(1).any(dim=1).tolist() == [True, True, False, False]
    neither = joined([part(1, 0, False), part(1, 0, False)])
    assert neither.points_m is None
    assert neither.holes is None


def test_scenes_of_several_datasets_and_paths(two_scenes):
    names = ["heads", "embedded/room", str(two_scenes / "half")]
    data = MultiSceneDataModule(names, root=str(two_scenes), **SIZES)
    found = [(each.hparams["dataset"], each.hparams["scene"]) for each in data.each_scene()]
    assert found == [("7scenes", "heads"), ("embedded", "room"), ("7scenes", str(two_scenes / "half"))]
    np.testing.assert_equal([each.scene_index for each in data.each_scene()], [0, 1, 2])


def test_a_recipes_data_is_of_one_scene_or_of_several(two_scenes):
    assert isinstance(build_data(scene="heads", root=str(two_scenes)), PoseDataModule)
    several = build_data(["heads", "half"], scene="never read", root=str(two_scenes), image_size=(32, 40))
    assert isinstance(several, MultiSceneDataModule)
    assert several.crop == (32, 40)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenes": ["heads"]}, "two scenes or more"),
        ({"scenes": ["heads", "heads"]}, "each once"),
        ({"scenes": ["heads", "half", "room"], "batch_size": 2}, "no image for some of 3 scenes"),
        ({"scenes": ["heads", "half"], "scene_share": "fair"}, "choose one of equal, size"),
    ],
)
def test_what_cannot_be_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        MultiSceneDataModule(**arguments)
