"""What new key frames add to a sparse map: poses that agree with it, views of its points, and points of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.mapping.building import epipolar_px, keypoint_tracks, points_of_tracks
from mambaloc.mapping.bundle_adjustment import Prior, adjust
from mambaloc.mapping.pairs import pairs_by_pose
from mambaloc.mapping.tracks import match_pair
from mambaloc.mapping.triangulation import Observations, residuals, triangulate
from mambaloc.runtime.maps import CameraPose, MapLocaliser
from mambaloc.runtime.maps.features import Features
from mambaloc.runtime.maps.viewpoints import spread_m

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

_BANDS = (3, 1)  # times how far a match may be from its epipolar line; poses that were found one after another drift
_LEAST_AGREEING = 0.3  # of the matches of a pair
_GIVEN_DEG = 1.0  # deviation of given poses


@dataclass(frozen=True)
class Extension:
    """What new key frames add.

    Shape:
        ``world_from_cam`` (N, 4, 4); ``views`` (P, N), which of them see which point of the map; ``points_m`` (T, 3),
        ``descriptors`` (T, 128) and ``new_views`` (T, N) of new points, the most seen first.
    """

    world_from_cam: Floats
    views: NDArray[np.bool_]
    points_m: Floats
    descriptors: NDArray[np.float32]
    new_views: NDArray[np.bool_]


def extend(
    localiser: MapLocaliser, features: Sequence[Features], world_from_cam: Floats, given: Floats | None
) -> Extension:
    """Adjust the poses of new key frames to the map's points, which stay, and to points that they see together.

    Args:
        localiser: in the map.
        features: of each new key frame.
        world_from_cam: where the map found it, (N, 4, 4).
        given: the same from elsewhere, a prior with a deviation of one degree; None where that is not known.
    """
    rng, band_px = np.random.default_rng(0), epipolar_px(localiser.map.size[0])
    cam_from_world = np.linalg.inv(world_from_cam)
    for band in _BANDS:
        look = _Look.of(localiser, features, cam_from_world, band * band_px)
        cam_from_world = _adjusted(localiser, look, cam_from_world, given)
    look = _Look.of(localiser, features, cam_from_world, band_px)
    points_m, descriptors, views = points_of_tracks(look.rest, cam_from_world, look.seen, look.keypoint, rng)
    order = np.argsort(-views.sum(axis=1), kind="stable")
    known = np.zeros((len(localiser.map), len(features)), bool)
    known[look.known.track, look.known.frame] = True
    return Extension(np.linalg.inv(cam_from_world), known, points_m[order], descriptors[order], views[order])


@dataclass(frozen=True)
class _Look:
    """What key frames see: ``known`` points of the map, whose rows are the tracks, and in the ``rest`` new tracks."""

    known: Observations
    rest: list[Features]
    seen: Observations
    keypoint: Indices

    @classmethod
    def of(cls, localiser: MapLocaliser, features: Sequence[Features], cam_from_world: Floats, band_px: float) -> _Look:
        known, rest = [], []
        for row, (each, pose) in enumerate(zip(features, np.linalg.inv(cam_from_world), strict=True)):
            keypoints, points = localiser.matches(each, CameraPose(pose[:3, :3], pose[:3, 3]))
            known.append((np.full(len(points), row), points, each.rays[keypoints]))
            rest.append(each.select(np.setdiff1d(np.arange(len(each)), keypoints)))
        frame, track, rays = (np.concatenate(each) for each in zip(*known, strict=True))
        order = np.argsort(track, kind="stable")
        near = np.full(len(order), band_px / localiser.map.intrinsics[0, 0])
        return cls(
            Observations(frame[order], track[order], rays[order], near), rest, *_tracks(rest, cam_from_world, band_px)
        )


def _tracks(features: Sequence[Features], cam_from_world: Floats, band_px: float) -> tuple[Observations, Indices]:
    """What the frames see together; pairs whose matches mostly disagree with the poses are left out."""
    pairs, matches = [], []
    for pair in pairs_by_pose(np.linalg.inv(cam_from_world)):
        rows, tried = match_pair(features, cam_from_world, pair, band_px)
        if len(rows) > _LEAST_AGREEING * tried:
            pairs.append(pair)
            matches.append(rows)
    if not pairs:
        nothing = np.empty(0, np.int64)
        return Observations(nothing, nothing, np.empty((0, 2)), np.empty(0)), nothing
    return keypoint_tracks(features, np.array(pairs), matches, band_px)


def _adjusted(localiser: MapLocaliser, look: _Look, cam_from_world: Floats, given: Floats | None) -> Floats:
    """Poses ``cam_from_world`` by bundle adjustment."""
    new_m, is_point, agrees = triangulate(cam_from_world, look.seen, np.random.default_rng(0))
    new, known = look.seen.select(agrees & is_point[look.seen.track]), look.known
    both = Observations(
        np.concatenate((known.frame, new.frame)),
        np.concatenate((known.track, len(localiser.map) + new.track)),
        np.concatenate((known.rays, new.rays)),
        np.concatenate((known.near, new.near)),
    )
    tracks, both = np.unique(both.track), both.renumbered()
    points_m = np.concatenate((localiser.map.points_m, new_m))[tracks]
    both = both.as_near_as(residuals(cam_from_world, both, points_m))
    unit_m = spread_m(localiser.map.key_poses)
    if given is None:
        start, prior = cam_from_world, Prior(np.pi, 10 * unit_m)
    else:
        start, prior = np.linalg.inv(given), Prior(np.radians(_GIVEN_DEG), np.radians(_GIVEN_DEG) * 3 * unit_m)
    is_fixed = tracks < len(localiser.map)
    return adjust(cam_from_world, both, points_m, prior, given=start, fixed=is_fixed)[0]
