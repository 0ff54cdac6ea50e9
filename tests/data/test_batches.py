"""Frames of a split outside of training: all of them, some, one by one, cropped as validation and test see them."""

import numpy as np
import pytest
import torch

from mambaloc.data import PoseDataModule

CROP = (28, 40)


@pytest.fixture(scope="module")
def data(scenes):
    """A scene of 12 training frames in clips of two, 12 for validation and 8 for test; frames of 48 x 36 pixels."""
    options = {"image_size": CROP, "short_side": 36, "eval_batch_size": 5, "validation": "sequences"}
    module = PoseDataModule(root=str(scenes), scene="heads", clip_length=2, clip_skip=1, points_per_frame=4, **options)
    module.setup("fit"), module.setup("test")
    return module


@pytest.mark.parametrize(("part", "sizes"), [("train", [5, 5, 2]), ("val", [5, 5, 2]), ("test", [5, 3])])
def test_all_frames_come_once_and_in_order(data, part, sizes):
    batches, frames = list(data.batches(part)), data.frames(part)
    assert [len(batch.image) for batch in batches] == sizes
    assert torch.cat([batch.index for batch in batches]).tolist() == list(range(len(frames)))
    assert {batch.clip_length for batch in batches} == {1}
    for name in ("position_m", "quaternion"):
        found = torch.cat([getattr(batch, name) for batch in batches])
        np.testing.assert_array_equal(found.numpy(), getattr(frames, name).astype(np.float32))


def test_images_are_the_middle_of_the_decoded_frames(data):
    decoded = data.test_dataloader().dataset.images
    found = torch.cat([batch.image for batch in data.batches("test")])
    np.testing.assert_array_equal(found.numpy(), decoded[..., 4:-4, 4:-4].astype(np.float32) / np.float32(255))


@pytest.mark.parametrize("part", ["val", "test"])
def test_batches_are_those_that_a_trainer_hands_to_a_system(data, part):
    loader = data.val_dataloader() if part == "val" else data.test_dataloader()
    for fetched, batch in zip(loader, data.batches(part), strict=True):
        expected = data.on_after_batch_transfer(fetched, 0)
        for name in ("image", "position_m", "quaternion", "index", "points_m", "intrinsics"):
            values = getattr(batch, name), getattr(expected, name)
            assert values == (None, None) or torch.equal(values[0].nan_to_num(), values[1].nan_to_num()), name


def test_some_frames_in_batches_of_any_size(data):
    (batch,) = data.batches("test", [6, 1, 1], size=7)
    assert batch.index.tolist() == [6, 1, 1]
    everything = torch.cat([each.image for each in data.batches("test")])
    assert torch.equal(batch.image, everything[[6, 1, 1]])
    assert [each.index.tolist() for each in data.batches("train", range(3), size=2)] == [[0, 1], [2]]
    assert list(data.batches("test", [])) == []


@pytest.mark.parametrize(("most", "rows"), [(1, [0]), (2, [0, 11]), (3, [0, 6, 11]), (12, range(12)), (99, range(12))])
def test_evenly_spread_frames_run_from_the_first_to_the_last(data, most, rows):
    assert data.frames("train").evenly_spread(most) == list(rows)
