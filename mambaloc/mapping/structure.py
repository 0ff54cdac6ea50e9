"""Structure from matches between posed frames: tracks, points, and poses that agree with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mambaloc.mapping.adjusting import Bundle, adjust, moves
from mambaloc.mapping.tracks import agreeing, connected
from mambaloc.mapping.triangulation import Observations, triangulate
from mambaloc.runtime.maps.features import Features
from mambaloc.runtime.maps.lens import Lens
from mambaloc.runtime.maps.viewpoints import spread_m

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

# How far a match may be from its epipolar line, and a point from where it is seen, in pixels of an image of 160: by
# round, with the poses as given, which drift by that much, and with adjusted ones.
_NEAR_PX = (4.0, 2.0)
_SIGMA_PX = 0.5
# How far given poses may drift: at first by 3 cm in a room that is filmed from its middle, then by what was found.
DRIFT = 0.05  # of the cameras' spread
DRIFT_RAD = np.radians(1.0)


@dataclass(frozen=True)
class Structure:
    """Points, where frames see them, and the poses and lenses that both agree with.

    Shape:
        ``world_from_cam`` (N, 4, 4); ``points_m`` (P, 3); ``descriptors`` (P, 128), means of unit length.

    Args:
        lenses: one a camera; the first alone, as claimed, where none was fitted.
        seen: where frames see the points, which are its tracks.
        agreeing: share of the matches that agree with the given poses.
    """

    world_from_cam: Floats
    lenses: tuple[Lens, ...]
    points_m: Floats
    descriptors: NDArray[np.float32]
    seen: Observations
    agreeing: float

    @property
    def views(self) -> NDArray[np.bool_]:
        """Which frames see each point, (P, N)."""
        return views_of(self.seen, len(self.points_m), len(self.world_from_cam))


def recover_structure(
    features: Sequence[Features],
    given: Floats,
    pairs: Indices,
    matches: Sequence[Indices],
    rng: np.random.Generator,
    depth_m: Sequence[Floats] | None = None,
    camera: Indices | None = None,
) -> Structure:
    """Triangulate with the given poses, adjust poses and lenses, and triangulate again.

    Args:
        features: of each frame.
        given: ``world_from_cam``, (N, 4, 4).
        pairs: of frames that were matched, (E, 2).
        matches: rows of keypoints of both frames of each pair.
        rng: draws views.
        depth_m: of each frame's keypoints along the optical axis, NaN where it was not measured.
        camera: which each frame was taken with, from 0 on, (N,); a lens is fitted for each. Otherwise one is fitted
            where all intrinsics are equal, and none where they are not.
    """
    unit_px = features[0].size[0] / 160
    focal_px = features[0].intrinsics[0, 0]
    if camera is None and all(np.allclose(each.intrinsics, features[0].intrinsics) for each in features):
        camera = np.zeros(len(features), np.int64)
    lenses = (Lens(),) if camera is None else (Lens(),) * (int(camera.max()) + 1)
    poses, share = given, np.nan
    drift = (DRIFT * spread_m(given), DRIFT_RAD)
    for near_px in _NEAR_PX:
        is_first = near_px == _NEAR_PX[0]
        points, seen, keypoint, kept = triangulated(features, poses, pairs, matches, near_px * unit_px, rng)
        share = kept / max(sum(len(each) for each in matches), 1) if is_first else share
        if not len(points):
            break
        sigma = _SIGMA_PX * unit_px / focal_px
        measured = None if depth_m is None else np.concatenate(depth_m)[keypoint]
        start = Bundle(poses, points, lenses) if is_first else Bundle(poses, points)
        bundle = adjust(start, given, drift, seen, sigma, camera if is_first else None, measured)
        poses = bundle.world_from_cam
        shift_m, turn_rad = np.sqrt((moves(given, poses).reshape(-1, 2, 3) ** 2).mean(axis=(0, 2)))
        drift = (min(drift[0], 2 * shift_m), min(drift[1], 2 * turn_rad))
        if is_first and camera is not None:
            lenses = bundle.lenses
            features = [lenses[number].straighten(each) for number, each in zip(camera, features, strict=True)]
    points, seen, keypoint, _ = triangulated(features, poses, pairs, matches, _NEAR_PX[-1] * unit_px, rng)
    return Structure(poses, lenses, points, mean_descriptors(features, len(points), seen, keypoint), seen, share)


def mean_descriptors(
    features: Sequence[Features], points: int, seen: Observations, keypoint: Indices
) -> NDArray[np.float32]:
    """Descriptors of points, (P, 128), means of unit length.

    On 150 held-out frames of a real room (160 key frames at 320 px) the medoid is as good: 95.3 instead of 94.0 %
    within 10 cm 5 deg. Three means a point give 96.7 %, for 2.6 times the bytes and 1.4 times the milliseconds; a
    quarter of the points, chosen by :func:`~mambaloc.mapping.choosing.most_useful`, 96.0 % with one.
    """
    descriptors = np.concatenate([each.descriptors for each in features])
    ones = np.ones(len(keypoint), np.float32)
    mean = csr_array((ones, (seen.track, keypoint)), (points, len(descriptors))) @ descriptors
    return mean / np.linalg.norm(mean, axis=1, keepdims=True)


def views_of(seen: Observations, points: int, frames: int) -> NDArray[np.bool_]:
    """Which frames see each point, (P, N)."""
    views = np.zeros((points, frames), bool)
    views[seen.track, seen.frame] = True
    return views


def triangulated(
    features: Sequence[Features],
    world_from_cam: Floats,
    pairs: Indices,
    matches: Sequence[Indices],
    near_px: float,
    rng: np.random.Generator,
) -> tuple[Floats, Observations, Indices, int]:
    """Triangulate, and once more what the first points leave of their tracks, where two points were taken for one.

    Returns:
        Points (P, 3), where they are seen (their rows are the tracks), which of all frames' keypoints each observation
        is, and how many matches agreed with the poses.
    """
    cam_from_world = np.linalg.inv(world_from_cam)
    kept = agreeing(features, cam_from_world, pairs, matches, near_px)
    seen, keypoint = _tracks(features, pairs, kept, near_px)
    found: list[Floats] = []
    observed, keypoints = [], []
    for _ in range(2):
        points, is_point, agrees = triangulate(cam_from_world, seen, rng)
        used = agrees & is_point[seen.track]
        row = np.cumsum(is_point) - 1 + sum(len(each) for each in found)
        observed.append((seen.frame[used], row[seen.track[used]], seen.rays[used], seen.near[used]))
        keypoints.append(keypoint[used])
        found.append(points[is_point])
        left = ~used
        left &= np.bincount(seen.track[left], minlength=len(points))[seen.track] >= 2
        seen, keypoint = seen.select(left).renumbered(), keypoint[left]
    whole = Observations(*(np.concatenate(each) for each in zip(*observed, strict=True)))
    return np.concatenate(found), whole, np.concatenate(keypoints), sum(len(each) for each in kept)


def _tracks(
    features: Sequence[Features], pairs: Indices, matches: Sequence[Indices], near_px: float
) -> tuple[Observations, Indices]:
    """Keypoints that matches connect, and which each is, of all frames' laid end to end (O,)."""
    first = np.cumsum([0, *(len(each) for each in features)])
    linked = [rows + first[pair] for pair, rows in zip(pairs, matches, strict=True)]
    edges = np.concatenate([np.empty((0, 2), np.int64), *linked])
    root = connected(first[-1], edges)
    keypoint = np.unique(edges)
    keypoint = keypoint[np.argsort(root[keypoint], kind="stable")]
    frame = np.searchsorted(first, keypoint, side="right") - 1
    rays = np.concatenate([each.rays for each in features])
    focal_px = np.array([each.intrinsics[0, 0] for each in features])
    return Observations(frame, root[keypoint], rays[keypoint], near_px / focal_px[frame]).renumbered(), keypoint
