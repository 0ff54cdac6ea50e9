"""Which answer counts, and how far off it may be."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mambaloc.runtime import Localization, combined
from mambaloc.runtime.maps import MapLocalization
from mambaloc.runtime.maps.radii import covariance_radius

NETWORK = Localization(np.array([1.0, 2, 3]), np.array([1.0, 0, 0, 0]), 0.01, 0.5, 9.0, 1.4)
COVARIANCE = np.diag([0.01, 0.01, 0.01, 0.0004, 0.0004, 0.0004])  # 0.1 m and 0.02 rad each way


def found(is_accepted):
    return MapLocalization(np.array([4.0, 5, 6]), np.array([0.6, 0.8, 0, 0]), 23, is_accepted, COVARIANCE)


def test_an_accepted_pose_of_the_map_is_the_answer():
    answer = combined(NETWORK, found(True))
    assert (answer.source, answer.inliers) == ("map", 23)
    assert answer.position_m.tolist() == [4, 5, 6]
    assert answer.quaternion.tolist() == [0.6, 0.8, 0, 0]
    assert answer.covariance is COVARIANCE
    assert answer.is_accepted
    metres_per_deviation = np.sqrt(chi2.ppf(0.9, 3))
    assert answer.position_radius_m == pytest.approx(0.1 * metres_per_deviation, rel=0.01)
    assert answer.rotation_radius_deg == pytest.approx(np.degrees(0.02) * metres_per_deviation, rel=0.01)
    assert NETWORK.is_unfamiliar
    assert not answer.is_unfamiliar  # the map has seen that it is the place


FAMILIAR = replace(NETWORK, unfamiliarity=0.5)


@pytest.mark.parametrize(
    ("network", "chance"),
    [
        (NETWORK, 0.0),  # the image does not look like the place
        (FAMILIAR, (1 - 0.1**0.16) * (1 - 0.1 ** (25 / 81))),
        (replace(FAMILIAR, position_radius_m=0.2, rotation_radius_deg=5.0), 0.81),
        (replace(FAMILIAR, position_radius_m=0.02, rotation_radius_deg=0.5), 1.0),
        (replace(FAMILIAR, position_radius_m=None, rotation_radius_deg=None), 0.1),
    ],
    ids=["unfamiliar", "poor", "good", "excellent", "says nothing"],
)
def test_of_two_poses_the_likelier_is_the_answer(network, chance):
    """Neither accepted; where the map's is chosen, the network's radii stand, and it is not called accepted."""
    for probability in (chance - 1e-6, chance + 1e-6):
        answer = combined(network, replace(found(False), probability=probability))
        is_map = probability > chance
        assert answer.source == ("map" if is_map else "network")
        assert answer.position_m.tolist() == ([4, 5, 6] if is_map else [1, 2, 3])
        assert (answer.position_radius_m, answer.inliers) == (network.position_radius_m, 23)
        assert answer.covariance is None
        assert not answer.is_accepted


def test_what_matches_ask_of_the_focal_length_is_passed_on():
    for is_accepted in (False, True):
        assert combined(NETWORK, replace(found(is_accepted), focal_scale=1.1)).focal_scale == 1.1


def test_otherwise_the_network_answers_with_its_own_radii():
    answer = combined(NETWORK, found(False))
    assert (answer.source, answer.inliers, answer.covariance) == ("network", 23, None)
    assert answer.position_m.tolist() == [1, 2, 3]
    assert (answer.position_radius_m, answer.rotation_radius_deg, answer.unfamiliarity) == (0.5, 9.0, 1.4)


def test_a_map_alone_answers_or_says_that_it_cannot():
    assert combined(None, found(True)).source == "map"
    lost = combined(None, replace(found(False), probability=0.8))
    assert (lost.source, lost.inliers, lost.position_radius_m) == (None, 23, None)
    assert np.isnan([*lost.position_m, *lost.quaternion]).all()


@pytest.mark.parametrize("deviations", [(1, 1, 1), (1, 0, 0), (1, 1, 0), (1, 0.5, 0.1), (3, 0.2, 0.2)])
@pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
def test_a_radius_holds_its_share_of_errors(deviations, level):
    """Drawn errors: the exact radius is their quantile. The approximation is worst for the smallest level."""
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    axes = turn * deviations
    errors = np.random.default_rng(0).normal(size=(400_000, 3)) @ axes.T
    exact = np.quantile(np.linalg.norm(errors, axis=1), level)
    assert covariance_radius(axes @ axes.T, level) == pytest.approx(exact, rel=0.03 if level >= 0.9 else 0.08)


def test_nothing_known_is_nothing_said():
    assert np.isnan(covariance_radius(np.full((3, 3), np.nan)))
    assert covariance_radius(np.zeros((3, 3))) == 0
