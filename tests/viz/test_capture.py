"""The drawing of a capture: seen from above and not from below, with all that it should show."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from mambaloc.images import read_image
from mambaloc.viz.capture import _JUMP_COLOR, COLORS, draw_capture, plot_axes

UPS = {
    "+x": (1, 0, 0),
    "-x": (-1, 0, 0),
    "+y": (0, 1, 0),
    "-y": (0, -1, 0),
    "+z": (0, 0, 1),
    "-z": (0, 0, -1),
    "tilted": np.array((1, 2, 3)) / np.sqrt(14),
}


@pytest.mark.parametrize("name", UPS)
def test_what_is_right_stays_right(name):
    """From above, the second direction is to the left of the first, and the third comes towards the eye."""
    up = np.array(UPS[name], dtype=float)
    position = np.random.default_rng(0).normal(size=(20, 3))
    axes, labels = plot_axes(position, up)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-12)
    np.testing.assert_allclose(axes[2], up)
    for axis, label in zip(axes, labels, strict=True):
        if name != "tilted":
            sign = -1 if label.startswith("-") else 1
            assert axis["xyz".index(label[-1])] == sign


def test_every_split_and_every_jump_is_drawn(tmp_path):
    position = np.stack((np.linspace(0, 5, 40), np.sin(np.linspace(0, 3, 40)), np.zeros(40)), axis=1)
    position[20:] += (0, 2, 0)
    split = np.repeat(["train", "unused", "val", "test"], 10).tolist()
    draw_capture(
        position, np.tile((0.0, 1, 0), (40, 1)), np.array((0.0, 0, 1)), split, ["a"] * 40, [20],
        tmp_path / "a.png", "a walk", "m",
    )  # fmt: skip
    picture = read_image(tmp_path / "a.png")
    for color in (*COLORS.values(), _JUMP_COLOR):
        wanted = 255 * np.array(to_rgb(color))
        assert (np.abs(picture - wanted).max(axis=-1) < 8).sum() > 20, color
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_capture_at_one_point_is_drawn_too(tmp_path):
    zeros = np.zeros((3, 3))
    draw_capture(
        zeros, zeros + np.eye(3)[0], np.array((0.0, 0, 1)), ["unused"] * 3, ["a"] * 3, [], tmp_path / "a.png", "", "m"
    )
    assert read_image(tmp_path / "a.png").size
