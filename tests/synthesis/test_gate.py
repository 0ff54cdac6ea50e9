"""The gate passes exact depth and refuses wrong depth; a held-out frame takes no part in its own view."""

from dataclasses import replace

import numpy as np
import pytest

from mambaloc.synthesis import held_out_quality
from mambaloc.viz.views import draw_views


@pytest.fixture(scope="module")
def of_exact_depth(walk):
    return held_out_quality(walk, 12)


def test_exact_depth_passes(of_exact_depth):
    assert of_exact_depth.correlation > 0.7
    assert of_exact_depth.share == 0.75
    assert "75 % of the images may be views" in of_exact_depth.describe()


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_depth_does_not(walk, of_exact_depth, factor):
    quality = held_out_quality(replace(walk, depth_m=walk.depth_m * np.float32(factor)), 12)
    assert quality.correlation < of_exact_depth.correlation - 0.2
    assert quality.share == 0
    assert "not worth training on" in quality.describe()


def test_frame_takes_no_part_in_its_own_view(walk, of_exact_depth):
    images = walk.images.copy()
    rows = np.linspace(0, len(walk) - 1, 12).round().astype(int)
    images[rows] = np.random.default_rng(0).integers(0, 256, images[rows].shape)
    quality = held_out_quality(replace(walk, images=images), 12)
    assert np.abs(quality.correlations).max() < 0.3  # noise is in none of the views of it


def test_contact_sheet_is_drawn(walk, of_exact_depth, tmp_path):
    from mambaloc.images import read_image
    from mambaloc.synthesis import Views

    views = Views(walk.images[:9], walk.depth_m[:9].astype(np.float16), walk.intrinsics[:9], walk.world_from_cam[:9])
    draw_views(walk, views, of_exact_depth, tmp_path / "views.png", "room")
    assert read_image(tmp_path / "views.png").std() > 30
