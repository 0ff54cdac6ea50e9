"""Which matches between images agree with a capture's poses and its camera, or with others in their stead.

A pair of poses draws a line in one image for each point of the other. Where poses, images and camera belong
together nearly every match lies near its line, and in front of both cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.importing.checks.matching import Matches
from mambaloc.mapping.tracks import sampson_distance
from mambaloc.runtime.rotations import quaternion_from_matrix, rotation_error_deg

Floats = NDArray[np.floating[Any]]

NEAR_PX = 1.5
"""How far a match may be from its line, were the longer side of the images 640 pixels."""

FOCALS = np.round(1.0125 ** np.arange(-28, 28), 4)
"""Focal lengths that are tried, over that of the capture."""

_MIN_MATCHES = 20  # matches; poses fitted to fewer agree with too many
_MAX_BINS = 6
_FOCAL_TURN_DEG = 8.0  # of pairs by which the focal length is judged: errors of poses grow with their turns
_FOCAL_MATCHES = 400


@dataclass(frozen=True)
class Bin:
    """Pairs of images that are about as far apart.

    Args:
        low: shortest baseline, in the capture's unit.
        high: longest.
        turn_deg: median.
        pairs: that have enough matches.
        matches: of these.
        share: of the matches that agree with the capture's poses.
        possible: that agree with the poses, or with one fitted to each pair alone.
        adjusted: that agree with adjusted poses, where there are some.
    """

    low: float
    high: float
    turn_deg: float
    pairs: int
    matches: int
    share: float
    possible: float
    adjusted: float | None = None


def agrees(matches: Matches, world_from_cam: Floats, focal: float = 1.0) -> NDArray[np.bool_]:
    """Which matches lie near their epipolar line and in front of both cameras, (M,).

    Args:
        matches: between images of N frames.
        world_from_cam: of each frame, (N, 4, 4).
        focal: focal length over that of the matches' camera.
    """
    first_from_world, second_from_world = np.linalg.inv(world_from_cam[matches.pairs.T])
    relative = second_from_world @ np.linalg.inv(first_from_world)
    second_from_first = relative[matches.pair]
    first, second = matches.first / focal, matches.second / focal
    near = NEAR_PX / (focal * matches.focal_px[matches.pair])
    has_moved = relative[:, :3, 3].any(axis=1)[matches.pair]
    is_near = sampson_distance(second_from_first, first, second) <= near
    return is_near & has_moved & _in_front(second_from_first, first, second, near)


def by_baseline(matches: Matches, world_from_cam: Floats, adjusted: Floats | None = None) -> list[Bin]:
    """The share of matches that agree by how far images are apart, with the most that any poses could reach.

    Args:
        matches: between images of N frames.
        world_from_cam: of each frame, (N, 4, 4).
        adjusted: other poses of the frames, in the same bins.
    """
    counts = matches.per_pair()
    enough = np.flatnonzero(counts >= _MIN_MATCHES)
    if not len(enough):
        return []
    agreeing = matches.per_pair(agrees(matches, world_from_cam))
    possible = np.array([max(_fitted(matches, pair), agreeing[pair]) for pair in enough.tolist()])
    counts, agreeing = counts[enough], agreeing[enough]
    after = None if adjusted is None else matches.per_pair(agrees(matches, adjusted))[enough]
    baseline, turn_deg = (each[enough] for each in pair_distances(matches, world_from_cam))
    edges = _round_edges(baseline)
    found = []
    for low, high in pairwise(edges):
        here = (baseline >= low) & (baseline < high)
        if not (total := int(counts[here].sum())):
            continue
        share, possible_share = float(agreeing[here].sum() / total), float(possible[here].sum() / total)
        share_after = None if after is None else float(after[here].sum() / total)
        middle_deg = float(np.median(turn_deg[here]))
        found.append(Bin(low, high, middle_deg, int(here.sum()), total, share, possible_share, share_after))
    return found


def by_focal(matches: Matches, world_from_cam: Floats) -> Floats:
    """The share of matches that agree at each of :data:`FOCALS`, by pairs turned little where there are some."""
    little = np.flatnonzero(pair_distances(matches, world_from_cam)[1] <= _FOCAL_TURN_DEG)
    judged = matches.of_pairs(little)
    judged = judged if len(judged.pair) >= _FOCAL_MATCHES else matches
    return np.array([agrees(judged, world_from_cam, focal).mean() for focal in FOCALS])


def best_focal(share: Floats) -> float:
    """Where the parabola through the highest share and its neighbours has its peak, over the capture's focal length."""
    at = int(np.clip(share.argmax(), 1, len(FOCALS) - 2))
    below, here, above = share[at - 1 : at + 2]
    bend = below - 2 * here + above
    offset = float(np.clip((below - above) / (2 * bend), -1, 1)) if bend < 0 else float(share.argmax() - at)
    return float(FOCALS[at] * (FOCALS[at + 1] / FOCALS[at]) ** offset)


def pair_distances(matches: Matches, world_from_cam: Floats) -> tuple[Floats, Floats]:
    """How far the images of each pair are apart, in the capture's unit and in degrees, (P,) each."""
    first, second = world_from_cam[matches.pairs.T]
    turn_deg = rotation_error_deg(*(quaternion_from_matrix(each[:, :3, :3]) for each in (first, second)))
    return np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1), turn_deg


def _round_edges(values: Floats) -> list[float]:
    """Edges 1, 2, 5, 10, ... around some lengths, so many at most: the first and last bin hold what is left."""
    steps = np.array([digit * 10.0**power for power in range(-9, 10) for digit in (1, 2, 5)])
    low, high = np.quantile(values, (0.02, 0.98))
    inner = steps[(steps > low) & (steps < high)][-(_MAX_BINS - 1) :]
    return [0.0, *inner.tolist(), float("inf")]


def _fitted(matches: Matches, pair: int) -> int:
    """How many matches of a pair agree with the pose that most agree with."""
    rows = slice(*np.searchsorted(matches.pair, (pair, pair + 1)))
    near = NEAR_PX / matches.focal_px[pair]
    first, second = matches.first[rows], matches.second[rows]
    _, inliers = cv2.findEssentialMat(first, second, np.eye(3), cv2.USAC_DEFAULT, 0.999, near, 300)
    return 0 if inliers is None else int(np.count_nonzero(inliers))


def _in_front(second_from_first: Floats, first: Floats, second: Floats, near: Floats) -> NDArray[np.bool_]:
    """Whether rays pass closest in front of both cameras, (M,); true where they are parallel to a pixel."""
    ones = np.ones((len(first), 1))
    turned = (second_from_first[:, :3, :3] @ np.hstack((first, ones))[..., None])[..., 0]
    end, shift = np.hstack((second, ones)), second_from_first[:, :3, 3]
    between = np.cross(turned, end)
    depth_second = (between * np.cross(turned, shift)).sum(axis=1)
    depth_first = (between * np.cross(end, shift)).sum(axis=1)
    sine = np.linalg.norm(between, axis=1) / (np.linalg.norm(turned, axis=1) * np.linalg.norm(end, axis=1))
    return (sine <= near) | ((depth_second > 0) & (depth_first > 0))
