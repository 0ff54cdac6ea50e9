"""Distances between frames against SciPy, at every angle and in blocks of any size."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.importing import motion
from mambaloc.importing.motion import pairwise_distances


def wxyz(rotation: Rotation):
    return np.roll(rotation.as_quat(), 1, axis=-1)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-9, 1e-6, 0.01, 30.0, 179.9, 180.0])
def test_small_angles_keep_their_digits(angle_deg):
    start = Rotation.random(1, rng=np.random.default_rng(1))
    end = start * Rotation.from_rotvec([[0.0, np.radians(angle_deg), 0.0]])
    quaternion = np.concatenate((wxyz(start), -wxyz(end)))
    _, turn_deg = pairwise_distances(np.zeros((2, 3)), quaternion, np.array([0]), np.array([1]))
    assert turn_deg.item() == pytest.approx(angle_deg, rel=1e-7, abs=1e-13)


@pytest.mark.parametrize("pairs_at_once", [1, 12, 1 << 20])
def test_every_pair_is_measured_whatever_the_block(monkeypatch, pairs_at_once):
    monkeypatch.setattr(motion, "_PAIRS_AT_ONCE", pairs_at_once)
    rng = np.random.default_rng(2)
    position, rotation = rng.normal(size=(9, 3)), Rotation.random(9, rng=rng)
    rows, others = np.array([8, 0, 3, 3, 5]), np.array([1, 3, 7, 2])
    length, turn_deg = pairwise_distances(position, wxyz(rotation), rows, others)
    assert length.shape == turn_deg.shape == (5, 4)
    for i, row in enumerate(rows):
        for j, other in enumerate(others):
            assert length[i, j] == pytest.approx(np.linalg.norm(position[row] - position[other]))
            between = rotation[row].inv() * rotation[other]
            assert turn_deg[i, j] == pytest.approx(np.degrees(between.magnitude()), abs=1e-12)
