"""Matches between frames that their poses allow, and tracks: keypoints of many frames that are one point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.runtime.maps.features import Features, distance, mutual, unambiguous

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

_RATIO = 0.8
_FARTHEST = 0.7  # of unit descriptors


def match(first: Features, second: Features) -> Indices:
    """Keypoints that are each other's nearest, clearly nearer than the second nearest; (M, 2) rows of both."""
    similarity = first.descriptors @ second.descriptors.T
    best, is_clear = unambiguous(similarity, _RATIO)
    if not is_clear.any():
        return np.empty((0, 2), np.int64)
    near = distance(similarity[np.arange(len(best)), best]) < _FARTHEST
    rows = np.flatnonzero(is_clear & near & mutual(similarity, best))
    return np.stack((rows, best[rows]), axis=1)


def sampson_distance(second_from_first: Floats, first: Floats, second: Floats) -> Floats:
    """How far matches are from their epipolar line, to first order.

    Args:
        second_from_first: transform between the cameras, (4, 4), or of each match, (M, 4, 4); its translation is not 0.
        first: points in the plane at depth 1 of the first camera, (M, 2).
        second: in the second's.

    Returns:
        Distances in that plane, (M,).
    """
    rotation, shift = second_from_first[..., :3, :3], second_from_first[..., :3, 3]
    ones = np.ones((len(first), 1))
    start, end = np.hstack((first, ones)), np.hstack((second, ones))
    lines = np.cross(shift, (rotation @ start[..., None])[..., 0])
    lines_back = (np.cross(end, shift)[:, None] @ rotation)[:, 0]
    slope = (lines[:, :2] ** 2).sum(axis=1) + (lines_back[:, :2] ** 2).sum(axis=1)
    return np.abs((end * lines).sum(axis=1)) / np.sqrt(np.maximum(slope, np.finfo(float).tiny))


def agreeing(
    features: Sequence[Features], cam_from_world: Floats, pair: Indices, rows: Indices, near_px: float
) -> Indices:
    """Keep the matches of two frames that lie near their epipolar line.

    Args:
        features: of every frame.
        cam_from_world: of every frame, (N, 4, 4).
        pair: two rows of frames.
        rows: of keypoints of both, (M, 2).
        near_px: how far from the line, in pixels of the frames as they were searched.
    """
    first, second = (features[row] for row in pair)
    second_from_first = cam_from_world[pair[1]] @ np.linalg.inv(cam_from_world[pair[0]])
    off = sampson_distance(second_from_first, first.rays[rows[:, 0]], second.rays[rows[:, 1]])
    return rows[off * first.intrinsics[0, 0] <= near_px]


def connected(count: int, edges: Indices) -> Indices:
    """Number the connected components of a graph: each node's smallest neighbour by any path, (count,).

    Args:
        count: of nodes.
        edges: pairs of keypoints, (E, 2).
    """
    root = np.arange(count)
    while (ends := root[edges]).size and (ends[:, 0] != ends[:, 1]).any():
        smaller = ends.min(axis=1)
        np.minimum.at(root, ends[:, 0], smaller)
        np.minimum.at(root, ends[:, 1], smaller)
        while (root[root] != root).any():
            root = root[root]
    return root
