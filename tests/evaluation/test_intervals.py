"""Intervals of medians against SciPy's bootstrap, and against what they promise."""

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from mambaloc.evaluation.intervals import block_resamples, difference_interval, median_interval


def test_blocks_stay_in_their_sequences_and_together():
    sequences = ["a"] * 30 + ["b"] * 7
    rows = block_resamples(sequences, block=10, resamples=50)
    assert rows.shape == (50, 37)
    for row in rows:
        start = 0
        while start < 37:
            length = 10 if sequences[row[start]] == "a" else 7
            part = row[start : start + length]
            np.testing.assert_array_equal(np.diff(part), 1)
            assert len({sequences[i] for i in part}) == 1
            start += length


def test_blocks_of_one_are_the_ordinary_bootstrap():
    errors = np.random.default_rng(0).gamma(2, 0.1, 120)
    found = median_interval(errors, block_resamples(["a"] * 120, block=1, resamples=9999))
    expected = stats.bootstrap(
        (errors,), np.median, method="percentile", n_resamples=9999, rng=np.random.default_rng(1)
    ).confidence_interval
    assert found == pytest.approx(tuple(expected), rel=0.03)


def test_every_seed_is_another_draw_and_one_seed_the_same():
    same, again, other = (block_resamples(["a"] * 40, resamples=20, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(same, again)
    assert not np.array_equal(same, other)


def test_intervals_of_a_video_hold_its_true_median_about_as_often_as_they_say():
    """Errors that wander slowly, as a camera's do: ordinary resampling holds it in half of the cases only."""
    rng, held = np.random.default_rng(0), {1: 0, 40: 0}
    for trial in range(60):
        walk = lfilter([np.sqrt(1 - 0.9**2)], [1, -0.9], rng.normal(size=1600))
        for block in held:
            low, high = median_interval(walk, block_resamples(["a"] * 1600, block, resamples=200, seed=trial))
            held[block] += low <= 0 <= high  # the true median is zero
    assert held[40] >= 50
    assert held[1] <= 42


def test_paired_differences_are_narrower_than_those_of_strangers():
    rng = np.random.default_rng(0)
    hard = rng.gamma(2, 0.2, 400)  # how hard each frame is
    a, b = hard + rng.normal(0, 0.01, 400) + 0.05, hard + rng.normal(0, 0.01, 400)
    rows = block_resamples(["a"] * 400, block=5)
    difference, low, high = difference_interval(a, b, rows)
    assert low < 0.05 < high
    assert difference == pytest.approx(np.median(a) - np.median(b))
    assert low > 0  # a is worse, and that is sure
    stranger = difference_interval(a, rng.permutation(b), rows)
    assert high - low < 0.5 * (stranger[2] - stranger[1])
    with pytest.raises(ValueError, match="the same frames"):
        difference_interval(a, b[:-1], rows)
