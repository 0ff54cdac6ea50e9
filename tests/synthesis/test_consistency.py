"""Depth that fits poses and depth that does not, made from exact depth."""

from dataclasses import replace

import numpy as np
import pytest

from mambaloc.errors import InputError
from mambaloc.synthesis import agreement, confirmed, without_disagreeing


@pytest.fixture(scope="module")
def names(walk):
    return [f"frame-{row}.depth.png" for row in range(len(walk))]


def test_exact_depth_agrees_in_every_frame(walk, names):
    assert agreement(walk).min() > 0.85
    kept, off = without_disagreeing(walk, names)
    assert len(kept) == len(walk)
    assert not off


def test_depth_of_other_frames_is_named_and_left_out(walk, names):
    depth_m = walk.depth_m.copy()
    depth_m[[10, 40]] = depth_m[[40, 10]]
    kept, off = without_disagreeing(replace(walk, depth_m=depth_m), names)
    assert set(off) == {"frame-10.depth.png", "frame-40.depth.png"}
    np.testing.assert_array_equal(kept.world_from_cam, np.delete(walk.world_from_cam, [10, 40], axis=0))


@pytest.mark.parametrize("factor", [1000, 10, 0.1, 0.001])
def test_depth_of_another_unit_is_refused_by_name(walk, names, factor):
    wrong = replace(walk, depth_m=walk.depth_m * np.float32(factor))
    with pytest.raises(
        InputError, match=r"frame-\d+\.depth\.png: depth of .* disagrees with the poses. Check the unit"
    ):
        without_disagreeing(wrong, names)


def test_frame_that_no_other_sees_is_kept(walk, names):
    apart = walk.world_from_cam.copy()
    apart[5, :3, 3] += 100
    kept, off = without_disagreeing(replace(walk, world_from_cam=apart), names)
    assert np.isnan(agreement(replace(walk, world_from_cam=apart))[5])
    assert len(kept) == len(walk)
    assert not off


def test_only_depth_that_others_confirm_is_kept(walk):
    depth_m = walk.depth_m.copy()
    depth_m[7, 20:50, 30:60] *= 1.3
    kept = np.isfinite(confirmed(replace(walk, depth_m=depth_m)).depth_m)
    assert kept[7, 20:50, 30:60].mean() < 0.05
    assert kept[20].mean() > 0.9
