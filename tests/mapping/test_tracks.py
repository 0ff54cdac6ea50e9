"""Matches, the epipolar test and tracks, against OpenCV and SciPy."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from mambaloc.mapping.tracks import connected, match, sampson_distance
from mambaloc.runtime.maps.features import Features

NODES = 12


@given(arrays.arrays(np.int64, st.tuples(st.integers(0, 20), st.just(2)), elements=st.integers(0, NODES - 1)))
def test_components_are_those_of_scipy(edges):
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(NODES, NODES))
    expected = connected_components(graph, directed=False)[1]
    root = connected(NODES, edges)
    np.testing.assert_array_equal(root[:, None] == root, expected[:, None] == expected)
    np.testing.assert_array_equal(root, [np.flatnonzero(expected == one).min() for one in expected])


def test_a_long_chain_is_one_component():
    order = np.random.default_rng(0).permutation(5000)
    assert not connected(5000, np.stack((order[:-1], order[1:]), axis=1)).any()


def test_sampson_distance_is_that_of_opencv():
    rng = np.random.default_rng(1)
    second_from_first = np.eye(4)
    second_from_first[:3, :3] = Rotation.from_rotvec((0.1, -0.2, 0.05)).as_matrix()
    second_from_first[:3, 3] = (0.3, 0.1, -0.05)
    x, y, z = second_from_first[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ second_from_first[:3, :3]
    first, second = rng.uniform(-0.5, 0.5, (2, 20, 2))
    expected = [
        cv2.sampsonDistance(np.array([[*a, 1.0]]).T, np.array([[*b, 1.0]]).T, essential)
        for a, b in zip(first, second, strict=True)
    ]
    assert sampson_distance(second_from_first, first, second) ** 2 == pytest.approx(expected, rel=1e-9)


def test_matches_are_mutual_and_clear():
    rng = np.random.default_rng(2)
    descriptors = rng.normal(size=(30, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    first = _features(descriptors[:20])
    # The second frame has 10 of those and 10 others, and keypoint 3 twice, so that nobody can say which it is.
    second = _features(descriptors[[*range(10), *range(20, 30), 3]])
    rows = match(first, second)
    assert rows.tolist() == [[i, i] for i in range(10) if i != 3]


@pytest.mark.parametrize("count", [0, 1])
def test_frames_with_hardly_a_keypoint_have_no_match(count):
    many = np.eye(128, dtype=np.float32)[:5]
    assert match(_features(many), _features(many[:count])).shape == (0, 2)
    assert match(_features(many[:count]), _features(many[:0])).shape == (0, 2)


def _features(descriptors):
    return Features(np.zeros((len(descriptors), 2)), descriptors, np.eye(3), (160, 120))
