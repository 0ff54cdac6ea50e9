"""The rule of acceptance: its regression against SciPy, its grid by hand, and focal lengths."""

import numpy as np
import pytest
from scipy.special import expit, logit

from mambaloc.runtime.maps import acceptance
from mambaloc.runtime.maps.acceptance import Evidence, is_another_focal_length, occupied_cells


def test_a_probability_is_that_of_the_regression():
    coefficients = (acceptance._PER_CELLS, acceptance._PER_DEVIATION, acceptance._PER_TURN)
    for cells, deviation, turn_deg in ((9, 0.02, 1.5), (3, 0.2, 6.0), (16, 0.004, 0.2)):
        linear = np.dot(coefficients, np.log([cells + 0.5, deviation, turn_deg + 0.1]))
        assert Evidence(cells, deviation, turn_deg).probability == pytest.approx(expit(acceptance._CONSTANT + linear))


def test_more_evidence_makes_a_pose_likelier():
    base = Evidence(8, 0.02, 2.0).probability
    assert Evidence(9, 0.02, 2.0).probability > base
    assert Evidence(8, 0.01, 2.0).probability > base
    assert Evidence(8, 0.02, 1.0).probability > base
    assert logit(Evidence(16, 0.003, 0.2).probability) > logit(acceptance.MIN_PROBABILITY) > logit(base) - 4


def test_a_likely_pose_that_is_not_precise_is_not_enough():
    most = acceptance.MAX_DEVIATION
    assert Evidence(16, most, 0.1).is_enough
    assert not Evidence(16, 1.01 * most, 0.1).is_enough
    assert Evidence(16, 1.01 * most, 0.1).probability > acceptance.MIN_PROBABILITY
    assert not Evidence(2, 0.01, 5.0).is_enough
    assert not Evidence(16, np.nan, 0.1).is_enough


def test_too_few_distinctive_matches_are_no_evidence():
    assert Evidence(3, np.inf, 0.0).probability == 0
    assert 0 < Evidence(0, 5.0, 180.0).probability < 0.05


def test_cells_of_a_grid_of_four_by_four_are_counted_once():
    assert occupied_cells(np.zeros((0, 2)), (160, 120)) == 0
    assert occupied_cells(np.array([[-0.5, -0.5], [39.4, 29.4]]), (160, 120)) == 1
    assert occupied_cells(np.array([[39.4, 29.4], [39.6, 29.4], [39.4, 29.6], [159.4, 119.4]]), (160, 120)) == 4
    grid = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), axis=-1).reshape(-1, 2)
    assert occupied_cells(grid, (160, 120)) == 16


@pytest.mark.parametrize(
    ("scale", "deviation", "is_another"),
    [(1.02, 0.001, False), (1.05, 0.001, True), (1 / 1.05, 0.001, True), (1.05, 0.02, False), (1.0, np.inf, False)],
)
def test_a_focal_length_is_another_where_it_is_far_off_and_sure(scale, deviation, is_another):
    assert is_another_focal_length(scale, deviation) is is_another
