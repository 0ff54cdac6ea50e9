"""What new key frames add to a sparse map: poses that agree with it, views of its points, and points of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.mapping.adjusting import Bundle, adjust
from mambaloc.mapping.choosing import most_useful
from mambaloc.mapping.pairs import pairs_by_pose
from mambaloc.mapping.structure import DRIFT, DRIFT_RAD, mean_descriptors, triangulated, views_of
from mambaloc.mapping.tracks import agreeing
from mambaloc.mapping.triangulation import Observations
from mambaloc.runtime.maps import CameraPose, MapLocalizer
from mambaloc.runtime.maps.features import Features
from mambaloc.runtime.maps.viewpoints import spread_m

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

# How far a match may be from its epipolar line, and a point from where it is seen, in pixels of an image of 160, by
# round: frames that were found one after another drift at first.
_NEAR_PX = (12.0, 4.0, 2.0)
_SIGMA = 0.125  # of that
_MIN_AGREEING = 0.3  # of the matches of a pair
_FREE = 3.0  # of the key frames' spread, and radians; how far poses that only the map gives may move


@dataclass(frozen=True)
class Extension:
    """What new key frames add.

    Shape:
        ``world_from_cam`` (N, 4, 4); ``views`` (P, N), which frames see which point of the map; ``points_m`` (T, 3),
        ``descriptors`` (T, 128) and ``new_views`` (T, N) of new points, the most seen first.
    """

    world_from_cam: Floats
    views: NDArray[np.bool_]
    points_m: Floats
    descriptors: NDArray[np.float32]
    new_views: NDArray[np.bool_]


def extend(
    localizer: MapLocalizer,
    features: Sequence[Features],
    matched: Callable[[int, int], Indices],
    world_from_cam: Floats,
    given: Floats | None,
    max_points: int,
) -> Extension:
    """Adjust the poses of new key frames to the map's points, which stay, and to points that they see together.

    Args:
        localizer: in the map.
        features: of each new key frame.
        matched: rows of keypoints that match between two frames, (M, 2).
        world_from_cam: where the map found it, (N, 4, 4).
        given: the same from elsewhere, a prior; None where that is not known.
        max_points: new points to keep.
    """
    sparse_map, rng, poses = localizer.map, np.random.default_rng(0), world_from_cam
    unit_m = spread_m(sparse_map.key_poses)
    drift = (_FREE * unit_m, _FREE) if given is None else (DRIFT * unit_m, DRIFT_RAD)
    unit_px, focal_px = sparse_map.size[0] / 160, sparse_map.intrinsics[0, 0]
    for near_px in _NEAR_PX:
        known, is_known = _known(localizer, features, poses, near_px * unit_px / focal_px)
        pairs, matches = _pairs(features, matched, is_known, poses, near_px * unit_px)
        points_m, seen, keypoint, _ = triangulated(features, poses, pairs, matches, near_px * unit_px, rng)
        if near_px != _NEAR_PX[-1] and len(poses) > 1:
            both, tracks = _joined(known, seen, len(sparse_map))
            every_m = np.concatenate((sparse_map.points_m, points_m))[tracks]
            start, is_fixed = Bundle(poses, every_m), tracks < len(sparse_map)
            sigma = _SIGMA * near_px * unit_px / focal_px
            prior = poses if given is None else given
            poses = adjust(start, prior, drift, both, sigma, is_fixed=is_fixed).world_from_cam
    descriptors = mean_descriptors(features, len(points_m), seen, keypoint)
    kept = most_useful(seen, len(points_m), max_points, sparse_map.size[0] / focal_px)
    old, new = (views_of(each, count, len(poses)) for each, count in ((known, len(sparse_map)), (seen, len(points_m))))
    return Extension(poses, old, points_m[kept], descriptors[kept], new[kept])


def _known(
    localizer: MapLocalizer, features: Sequence[Features], world_from_cam: Floats, near: float
) -> tuple[Observations, list[NDArray[np.bool_]]]:
    """What frames see of the map, whose points are the tracks, and which of their keypoints these are."""
    found, is_known = [], [np.zeros(len(each), bool) for each in features]
    for row, (each, pose) in enumerate(zip(features, world_from_cam, strict=True)):
        keypoints, points = localizer.matches(each, CameraPose(pose[:3, :3], pose[:3, 3]))
        found.append((np.full(len(points), row), points, each.rays[keypoints]))
        is_known[row][keypoints] = True
    frame, track, rays = (np.concatenate(each) for each in zip(*found, strict=True))
    order = np.argsort(track, kind="stable")
    return Observations(frame[order], track[order], rays[order], np.full(len(order), near)), is_known


def _pairs(
    features: Sequence[Features],
    matched: Callable[[int, int], Indices],
    is_known: Sequence[NDArray[np.bool_]],
    world_from_cam: Floats,
    near_px: float,
) -> tuple[Indices, list[Indices]]:
    """Pairs of frames and their new matches, but for pairs whose matches mostly disagree with the poses."""
    pairs, matches = [], []
    cam_from_world = np.linalg.inv(world_from_cam)
    for first, second in pairs_by_pose(world_from_cam).tolist():
        rows = matched(first, second)
        (agree,) = agreeing(features, cam_from_world, np.array([(first, second)]), [rows], near_px)
        if len(agree) > _MIN_AGREEING * len(rows):
            pairs.append((first, second))
            matches.append(agree[~is_known[first][agree[:, 0]] & ~is_known[second][agree[:, 1]]])
    return np.array(pairs, np.int64).reshape(-1, 2), matches


def _joined(known: Observations, seen: Observations, points: int) -> tuple[Observations, Indices]:
    """Observations of the map's points and of new ones, and the rows of those in both laid end to end."""
    both = Observations(
        np.concatenate((known.frame, seen.frame)),
        np.concatenate((known.track, points + seen.track)),
        np.concatenate((known.rays, seen.rays)),
        np.concatenate((known.near, seen.near)),
    )
    return both.renumbered(), np.unique(both.track)
