"""Poses of a capture adjusted to its pictures by bundle adjustment: an offer beside those given, not a replacement."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.importing.capture import Capture
from mambaloc.importing.checks.depth import sampled
from mambaloc.importing.checks.matching import LONG_SIDE_PX, searched, shown
from mambaloc.mapping.building import epipolar_px, keypoint_tracks
from mambaloc.mapping.bundle_adjustment import Prior, adjust
from mambaloc.mapping.pairs import pairs_by_pose
from mambaloc.mapping.tracks import match, sampson_distance
from mambaloc.mapping.triangulation import Observations, triangulate
from mambaloc.runtime.maps.features import Features
from mambaloc.runtime.rotations import quaternion_from_matrix, rotation_error_deg

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

_MOST_FRAMES = 200  # the others move with their neighbours
_ROUNDS = 2  # of triangulation and adjustment: better poses find more matches
_PRIOR_DEG = 1.0
_LEAST_POINTS = 50


@dataclass(frozen=True)
class Adjusted:
    """Adjusted poses, and how they were found.

    Args:
        world_from_cam: (N, 4, 4), a frame each.
        frames: that were adjusted; the others move with their neighbours.
        points: that these see.
        moved: how far camera centres moved, in the capture's unit, median.
        turned_deg: how far cameras turned, median.
        turns: length of the turns between neighbours over that before.
        with_depth: whether depth held the scale and the turns.
    """

    world_from_cam: Floats
    frames: int
    points: int
    moved: float
    turned_deg: float
    turns: float
    with_depth: bool


def adjust_poses(capture: Capture) -> Adjusted:
    """Adjust poses to what the pictures show, with the given ones and depth, where there is some, as priors.

    Args:
        capture: its images are those of pinholes.

    Raises:
        InputError: where its pictures give too few points.
    """
    every = np.arange(len(capture.images))
    rows = every[:: -(-len(every) // _MOST_FRAMES)]
    given = np.linalg.inv(capture.world_from_cam[rows])
    pairs = pairs_by_pose(capture.world_from_cam[rows])
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = pool.map(lambda row: searched(capture, row), rows.tolist())
        features = list(shown(found, "Finding keypoints", len(rows)))
        of_pairs = pool.map(lambda pair: match(features[pair[0]], features[pair[1]]), pairs.tolist())
        matches = list(shown(of_pairs, "Matching pictures", len(pairs)))
    poses = given
    for _ in range(_ROUNDS):
        seen, points = _points(features, poses, pairs, matches)
        if len(points) < _LEAST_POINTS:
            raise InputError(
                f"--adjust-poses: the pictures give {len(points)} points. Film more texture, or leave it out."
            )
        depth = _depth(capture, rows, seen)
        away = np.einsum("oj,oj->o", poses[seen.frame, 2, :3], points[seen.track]) + poses[seen.frame, 2, 3]
        prior = Prior(given, np.radians(_PRIOR_DEG), np.radians(_PRIOR_DEG) * float(np.median(away)))
        poses, points = adjust(poses, seen, points, prior, depth)
    before, after = np.linalg.inv(given), np.linalg.inv(poses)
    quaternion = (quaternion_from_matrix(each[:, :3, :3]) for each in (before, after))
    return Adjusted(
        _carried(capture, rows, before, after),
        len(rows),
        len(points),
        float(np.median(np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1))),
        float(np.median(rotation_error_deg(*quaternion))),
        _turns(poses) / _turns(given),
        bool(np.isfinite(depth).any()),
    )


def _points(
    features: list[Features], poses: Floats, pairs: Indices, matches: list[Indices]
) -> tuple[Observations, Floats]:
    """Triangulate the matches near their epipolar line, and keep the observations that agree."""
    near, kept = epipolar_px(LONG_SIDE_PX), []
    for (first, second), rows in zip(pairs.tolist(), matches, strict=True):
        rays = features[first].rays[rows[:, 0]], features[second].rays[rows[:, 1]]
        off = sampson_distance(poses[second] @ np.linalg.inv(poses[first]), *rays)
        kept.append(rows[off * features[first].intrinsics[0, 0] <= near])
    seen, _ = keypoint_tracks(features, pairs, kept, near)
    points, is_point, agrees = triangulate(poses, seen, np.random.default_rng(0))
    used = agrees & is_point[seen.track]
    used &= np.bincount(seen.track[used], minlength=len(points))[seen.track] >= 2
    return seen.select(used).renumbered(), points[np.unique(seen.track[used])]


def _depth(capture: Capture, rows: Indices, seen: Observations) -> Floats:
    found = np.full(len(seen), np.nan)
    for place, row in enumerate(rows.tolist()):
        if capture.depth is not None and (file := capture.depth.files[row]) is not None:
            found[seen.frame == place] = sampled(capture.depth, file, seen.rays[seen.frame == place])
    return found


def _carried(capture: Capture, rows: Indices, given: Floats, adjusted: Floats) -> Floats:
    """Move and turn every frame as the adjusted frames around it were, interpolated within its sequence."""
    found, names = capture.world_from_cam.copy(), np.array(capture.sequences)
    moves = adjusted[:, :3, 3] - given[:, :3, 3]
    turns = adjusted[:, :3, :3] @ given[:, :3, :3].swapaxes(1, 2)
    changes = np.column_stack((moves, [cv2.Rodrigues(turn)[0][:, 0] for turn in turns]))
    for name in dict.fromkeys(capture.sequences):
        every = np.flatnonzero(names == name)
        here = np.flatnonzero(names[rows] == name)
        if not len(here):
            continue
        change = np.column_stack([np.interp(every, rows[here], column) for column in changes[here].T])
        found[every, :3, 3] += change[:, :3]
        found[every, :3, :3] = np.array([cv2.Rodrigues(turn)[0] for turn in change[:, 3:]]) @ found[every, :3, :3]
    return found


def _turns(poses: Floats) -> float:
    """Sum of the turns from frame to frame."""
    between = poses[1:, :3, :3] @ poses[:-1, :3, :3].swapaxes(1, 2)
    return float(sum(np.linalg.norm(cv2.Rodrigues(turn)[0]) for turn in between))
