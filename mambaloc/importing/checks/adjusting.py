"""Poses and focal lengths of a capture adjusted to its images: an offer beside those given, not a replacement."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.importing.capture import Capture
from mambaloc.importing.checks.depth import sampled
from mambaloc.importing.checks.matching import searched, shown
from mambaloc.mapping.adjusting import moves
from mambaloc.mapping.pairs import pairs_by_pose
from mambaloc.mapping.structure import recover_structure
from mambaloc.mapping.tracks import match
from mambaloc.runtime.maps.features import Features
from mambaloc.runtime.maps.lens import Lens
from mambaloc.runtime.rotations import quaternion_from_matrix, rotation_error_deg

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

_MAX_FRAMES = 100  # the others move with their neighbours
_MIN_POINTS = 50
_MIN_FRAMES = 8  # of each camera, so that its lens is fitted


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
        focal: the fitted focal length over that given, by camera; empty where the capture gives none, or where a camera
            took too few of the frames.
    """

    world_from_cam: Floats
    frames: int
    points: int
    moved: float
    turned_deg: float
    turns: float
    with_depth: bool
    focal: Mapping[str, float]


def adjust_poses(capture: Capture) -> Adjusted:
    """Adjust poses and lenses to what the images show; the given ones, and depth where there is some, are priors.

    Args:
        capture: its images are those of pinholes.

    Raises:
        InputError: where its images give too few points.
    """
    every, stride = np.arange(len(capture.images)), -(-len(capture.images) // _MAX_FRAMES)
    rows = every[::stride]
    given = capture.world_from_cam[rows]
    pairs = pairs_by_pose(given)
    if not len(pairs):
        raise InputError(
            "--adjust-poses: no two frames look the same way from apart. Film while walking, or leave it out."
        )
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = pool.map(lambda row: searched(capture, row), rows.tolist())
        features = list(shown(found, "Finding keypoints", len(rows)))
        of_pairs = pool.map(lambda pair: match(features[pair[0]], features[pair[1]]), pairs.tolist())
        matches = list(shown(of_pairs, "Matching images", len(pairs)))
    depth = None
    if capture.depth is not None:
        depth = [sampled(capture.depth, row, each.rays) for row, each in zip(rows.tolist(), features, strict=True)]
    names, camera = _cameras(capture, rows)
    structure = recover_structure(features, given, pairs, matches, np.random.default_rng(0), depth, camera)
    if len(structure.points_m) < _MIN_POINTS:
        raise InputError(
            f"--adjust-poses: the images give {len(structure.points_m)} points. Film more texture, or leave it out."
        )
    after = structure.world_from_cam
    quaternion = (quaternion_from_matrix(each[:, :3, :3]) for each in (given, after))
    return Adjusted(
        _carried(capture, rows, after),
        len(rows),
        len(structure.points_m),
        float(np.median(np.linalg.norm(after[:, :3, 3] - given[:, :3, 3], axis=1))),
        float(np.median(rotation_error_deg(*quaternion))),
        _turns(after) / max(_turns(given), 1e-12),
        depth is not None,
        {} if camera is None else _focal(names, structure.lenses, features, camera),
    )


def _cameras(capture: Capture, rows: Indices) -> tuple[list[str], Indices | None]:
    """Names of the frames' cameras, and which each frame was taken with; None where no lens is fitted for each."""
    if capture.camera_of is None:
        return [], None
    names, camera = np.unique([capture.camera_of[row] for row in rows], return_inverse=True)
    return names.tolist(), camera if np.bincount(camera).min() >= _MIN_FRAMES else None


def _focal(
    names: Sequence[str], lenses: Sequence[Lens], features: Sequence[Features], camera: Indices
) -> dict[str, float]:
    """The focal length of the pinhole that is nearest to each lens where images have keypoints, over that given."""
    found = {}
    for number, (name, lens) in enumerate(zip(names, lenses, strict=True)):
        rays = [each.rays for each, own in zip(features, camera == number, strict=True) if own]
        ideal = lens.undistort(np.concatenate(rays))
        found[name] = float((lens.distort(ideal) * ideal).sum() / max((ideal**2).sum(), 1e-12))
    return found


def _carried(capture: Capture, rows: Indices, adjusted: Floats) -> Floats:
    """Move and turn every frame as the adjusted frames around it were, interpolated within its sequence."""
    found, names = capture.world_from_cam.copy(), np.array(capture.sequences)
    changes = moves(found[rows], adjusted)
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
