"""Keypoints where they are, intrinsics that follow a resize, and the comparison of descriptors."""

import numpy as np
import pytest
import torch

from mambaloc.errors import InputError
from mambaloc.geometry import resized_intrinsics
from mambaloc.runtime.maps.features import (
    dequantized,
    detect_features,
    distance,
    mutual,
    normalized,
    quantized,
    rescaled_intrinsics,
    unambiguous,
)

INTRINSICS = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])


def _blob(x, y, radius, size=(160, 120)):
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    grey = 40 + 180 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * radius**2))
    return np.repeat(grey.round().astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("radius", [1.7, 3.0, 6.0])
@pytest.mark.parametrize("scale", [1, 0.5])
def test_keypoints_lie_where_their_blobs_do(radius, scale):
    """At any scale; without the precise upscale each would be a quarter of a pixel off."""
    x, y = 71.3, 58.8
    found = detect_features(_blob(x, y, radius / scale), INTRINSICS, scale)
    assert len(found) >= 1
    off = np.linalg.norm(found.rays - normalized((x, y), INTRINSICS), axis=1) * found.intrinsics[0, 0]
    assert off.min() < 0.08


def test_descriptors_have_unit_length():
    picture = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8).repeat(5, 0).repeat(5, 1)
    found = detect_features(picture, INTRINSICS, 1)
    assert len(found) > 50
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-3)
    stored = dequantized(quantized(found.descriptors))
    assert (stored * found.descriptors).sum(axis=1).min() > 0.999


def test_a_blank_picture_has_no_keypoint():
    found = detect_features(np.full((120, 160, 3), 90, np.uint8), INTRINSICS, 0.5)
    assert (len(found), found.rays.shape, found.descriptors.shape) == (0, (0, 2), (0, 128))


def test_intrinsics_follow_a_resize_as_those_of_torch_do():
    expected = resized_intrinsics(torch.from_numpy(INTRINSICS), 0.5, 0.25).numpy()
    np.testing.assert_allclose(rescaled_intrinsics(INTRINSICS, (160, 120), (80, 30)), expected)


@pytest.mark.parametrize(
    "wrong",
    [np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan), np.eye(4), INTRINSICS * 4, np.diag((150.0, 150.0, 1))],
)
def test_intrinsics_of_another_picture_are_refused(wrong):
    with pytest.raises(InputError, match=r"cannot be the camera of an image of 160x120") as error:
        detect_features(_blob(80, 60, 3), wrong, 1)
    assert "\n" not in str(error.value)


def test_matching_is_that_of_a_plain_loop():
    rng = np.random.default_rng(3)
    first, second = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in rng.normal(size=(2, 30, 4)))
    similarity = (first @ second.T).astype(np.float32)
    before = similarity.copy()
    best, is_clear = unambiguous(similarity, 0.8)
    is_mutual = mutual(similarity, best)
    np.testing.assert_array_equal(similarity, before)
    for row, each in enumerate(first):
        apart = np.linalg.norm(second - each, axis=1)
        order = np.argsort(apart)
        assert best[row] == order[0]
        assert is_clear[row] == (apart[order[0]] < 0.8 * apart[order[1]])
        assert is_mutual[row] == (np.linalg.norm(first - second[order[0]], axis=1).argmin() == row)
        assert distance(similarity[row, best[row]]) == pytest.approx(apart[order[0]], abs=1e-3)


@pytest.mark.parametrize("columns", [0, 1])
def test_nothing_is_clear_without_a_second(columns):
    assert not unambiguous(np.ones((3, columns), np.float32), 0.8)[1].any()
