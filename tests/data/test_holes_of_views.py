"""Holes of views, where they show nothing of the scene: other images of the batch fill them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from mambaloc.data.augmentation import Jitter, RandomCrop, RandomRotation, filled_from_each_other
from mambaloc.data.frame_dataset import CachedFrames
from mambaloc.data.frames import Cameras, Frames
from mambaloc.data.views import FramesAndViews
from mambaloc.synthesis import Views
from mambaloc.types import PoseBatch

SIZE = (12, 16)
K = np.array([[14.0, 0, 7.5], [0, 14, 5.5], [0, 0, 1]])
UPRIGHT = torch.tensor([[1.0, 0, 0, 0]])


def greys(*values):
    """Images of one grey each, (B, 3, H, W) uint8."""
    return torch.tensor(values, dtype=torch.uint8)[:, None, None, None].expand(-1, 3, *SIZE).contiguous()


def test_a_hole_shows_what_the_nearest_image_without_one_shows_there():
    image = torch.arange(5.0)[:, None, None, None].expand(-1, 3, *SIZE)
    holes = torch.zeros(5, *SIZE, dtype=torch.bool)
    holes[1:3, :4], holes[4, 4:8], holes[:, -1] = True, True, True
    out = filled_from_each_other(image, holes)
    assert (out[1, :, :4] == 0).all()
    assert (out[2, :, :4] == 0).all()  # image 1 has the same hole
    assert (out[4, :, 4:8] == 3).all()
    assert (out[:, :, -1] == image[:, :, -1]).all()  # no image knows it
    kept = ~holes[:, None].expand_as(image)
    assert (out[kept] == image[kept]).all()


def test_a_hole_turns_with_its_view_and_borders_stay_black():
    holes = torch.zeros(2, *SIZE, dtype=torch.bool)
    holes[1, :, 8:] = True
    batch = PoseBatch(
        greys(100, 200), torch.zeros(2, 3), UPRIGHT.expand(2, -1), torch.arange(2),
        intrinsics=torch.from_numpy(K).float().expand(2, -1, -1), holes=holes,
    )  # fmt: skip
    still = RandomRotation(SIZE, 20.0)
    colors = Jitter(0, 0, 0).matrices(batch.image, torch.full((2, 3), 0.5))
    middle = torch.full((2, 4), 0.5)
    out = still(batch, colors, middle)
    assert torch.equal(out.holes, holes)
    expected = torch.where(holes[1], 100 / 255, 200 / 255)
    torch.testing.assert_close(out.image[1, 0], expected, rtol=0, atol=0.2 / 255 + 100 / 255 * 1e-3)
    turned = still(batch, colors, middle + torch.tensor([0, 0.45, 0, 0]))  # by 18 degrees about y, to the right
    assert turned.holes[1, :, 4:9].all()
    assert not turned.holes[:, :, -1].any()
    assert (turned.image[:, :, :, -1] == 0).all()


def test_a_crop_takes_its_part_of_a_hole():
    holes = torch.zeros(2, *SIZE, dtype=torch.bool)
    holes[1, :6] = True
    batch = PoseBatch(greys(100, 200), torch.zeros(2, 3), UPRIGHT.expand(2, -1), torch.arange(2), holes=holes)
    colors = Jitter(0, 0, 0).matrices(batch.image, torch.full((2, 3), 0.5))
    out = RandomCrop((6, 8))(batch, colors, torch.tensor([[0.0, 0.0], [0.5, 0.0]]))
    assert out.holes[1].sum(dim=0).tolist() == [3] * 8  # rows 3 to 8 of the view
    torch.testing.assert_close(out.image[1, 0, :, 0] * 255, torch.tensor([100.0] * 3 + [200.0] * 3))


def test_pixels_of_views_without_depth_are_holes_and_frames_have_none():
    frames = Frames((Path("a"), Path("b")), ("s", "s"), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    cameras = Cameras(np.tile(K, (2, 1, 1)), np.tile((16, 12), (2, 1)))
    real = CachedFrames(frames, greys(10, 20).numpy(), cameras)
    depth_m = np.ones((3, *SIZE), np.float16)
    depth_m[1, 2:5, 3:9] = np.nan
    views = Views(greys(30, 40, 50).numpy(), depth_m, np.tile(K, (3, 1, 1)), np.tile(np.eye(4), (3, 1, 1)))
    both = FramesAndViews(real, views, 0.5)
    for data in (both, both.to(torch.device("cpu"))):
        batch = data.__getitems__([0, 3, 1, 4])
        assert batch.image[:, 0, 0, 0].tolist() == [10, 40, 20, 50]
        assert batch.holes.sum(dim=(1, 2)).tolist() == [0, 18, 0, 0]
        assert batch.holes[1, 2:5, 3:9].all()
