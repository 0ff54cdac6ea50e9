"""Curves: what the lines on the axes are."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from mambaloc.viz.curves import Point, axis_limit, plot_cumulative, plot_errors_by_frames, plot_errors_by_time


@pytest.fixture
def axes():
    return Figure().subplots()


def test_cumulative_curve_is_the_empirical_distribution(axes):
    errors = np.random.default_rng(0).gamma(2, 0.1, 101)
    plot_cumulative(axes, {"a": errors})
    x, share = axes.lines[0].get_data()
    for limit in (0.05, 0.2, 0.4):
        assert share[x <= limit][-1] == pytest.approx(np.mean(errors <= limit))
    assert x[np.argmax(share >= 0.5)] == pytest.approx(np.median(errors))  # where it meets the dotted line
    assert axis_limit([errors, errors / 2]) == pytest.approx(np.percentile(errors, 95))


def test_each_training_is_a_line_and_each_system_a_color(axes):
    plot_errors_by_time(axes, {"a": [([1, 2], [0.5, 0.4]), ([1, 3], [0.6, 0.3])], "b": [([2], [0.7])]})
    first, second, other = axes.lines
    np.testing.assert_array_equal(second.get_data(), [[1, 3], [0.6, 0.3]])
    assert first.get_color() == second.get_color() != other.get_color()
    assert axes.get_legend_handles_labels()[1] == ["a", "b"]  # one entry a system


def test_points_stand_in_order_with_their_intervals(axes):
    plot_errors_by_frames(axes, {"a": [Point(800, 0.2, 0.1, 0.4), Point(40, 0.5, 0.3, 0.6)]})
    line, _, (bars,) = axes.containers[0]
    np.testing.assert_allclose(line.get_xydata(), [[40, 0.5], [800, 0.2]])
    ends = [segment[:, 1] for segment in bars.get_segments()]
    np.testing.assert_allclose(ends, [[0.3, 0.6], [0.1, 0.4]])
    assert axes.get_xscale() == "log"
    assert list(axes.get_xticks()) == [40, 800]
