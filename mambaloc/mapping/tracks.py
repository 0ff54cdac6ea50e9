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
    features: Sequence[Features], cam_from_world: Floats, pairs: Indices, matches: Sequence[Indices], near_px: float
) -> list[Indices]:
    """Keep the matches that lie near their epipolar line, all pairs of frames at once.

    Args:
        features: of every frame.
        cam_from_world: of every frame, (N, 4, 4).
        pairs: rows of frames, (E, 2).
        matches: rows of keypoints of both frames of each pair, (M, 2).
        near_px: how far from the line, in pixels of the frames as they were searched.
    """
    if not len(pairs):
        return []
    first, second = (
        np.concatenate([features[frame].rays[rows[:, side]] for frame, rows in zip(frames, matches, strict=True)])
        for side, frames in enumerate(pairs.T)
    )
    counts = [len(rows) for rows in matches]
    second_from_first = cam_from_world[pairs[:, 1]] @ np.linalg.inv(cam_from_world[pairs[:, 0]])
    focal_px = np.array([features[frame].intrinsics[0, 0] for frame in pairs[:, 0]])
    off = sampson_distance(np.repeat(second_from_first, counts, axis=0), first, second)
    is_near = np.split(off * np.repeat(focal_px, counts) <= near_px, np.cumsum(counts)[:-1])
    return [rows[near] for rows, near in zip(matches, is_near, strict=True)]


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
