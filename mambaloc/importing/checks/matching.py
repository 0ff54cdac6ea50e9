"""Matches between images of a capture: what its poses and its camera are checked against."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mambaloc.data.cameras import assumed_intrinsics
from mambaloc.images import Image, read_image
from mambaloc.importing.capture import Capture
from mambaloc.importing.motion import Motion, pairwise_distances, quaternions
from mambaloc.mapping.pairs import pairs_by_pose
from mambaloc.mapping.tracks import match
from mambaloc.runtime.maps.features import Features, detect_features

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

T = TypeVar("T")

LONG_SIDE_PX = 640
"""Longest side of the images in which keypoints are searched."""

_NEIGHBOURS = 16  # frames, with another that is turned little and one that is turned more
_OFFSETS = (32, 24, 16, 12, 8, 6, 4, 3, 2, 1)  # frames from one of a pair to the other; larger baselines constrain more
_MAX_TURNS_DEG = (8.0, 15.0)
_MIN_MOVE = 0.01  # of the extent; turned on the spot, a camera draws no lines
_MAX_FRAMES = 32  # that pairs by pose are chosen from


@dataclass(frozen=True)
class Matches:
    """Matches of pairs of images, laid end to end.

    Shape:
        ``pairs`` (P, 2) rows of the capture; ``pair`` (M,) ascending; ``first`` and ``second`` (M, 2), where keypoints
        lie in the plane at depth 1 of their cameras; ``focal_px`` (P,) in images whose longer side is 640 pixels.

    Args:
        pairs: neighbours in time come first.
        neighbours: how many pairs are.
        is_guessed: the focal length is assumed, since the format does not give one.
    """

    pairs: Indices
    pair: Indices
    first: Floats
    second: Floats
    focal_px: Floats
    neighbours: int
    is_guessed: bool

    def of_pairs(self, chosen: Indices) -> Matches:
        """The matches of some pairs, ascending."""
        rows = np.isin(self.pair, chosen)
        return Matches(
            self.pairs[chosen],
            np.searchsorted(chosen, self.pair[rows]),
            self.first[rows],
            self.second[rows],
            self.focal_px[chosen],
            int((chosen < self.neighbours).sum()),
            self.is_guessed,
        )

    def per_pair(self, counts: NDArray[np.generic] | None = None) -> Indices:
        """How many matches each pair has, or how many of those that count, (P,)."""
        return np.bincount(self.pair if counts is None else self.pair[counts], minlength=len(self.pairs))


def find_matches(capture: Capture, motion: Motion) -> Matches:
    """Match images that follow each other, and images that the poses say show the same from apart.

    Args:
        capture: its images are those of pinholes, where it has cameras.
        motion: its.
    """
    near = neighbours(capture, motion)
    pairs = np.array([*near, *sorted({*_by_pose(capture, near)} - {*near})], np.int64).reshape(-1, 2)
    rows = np.unique(pairs)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        of_rows = pool.map(lambda row: searched(capture, row), rows.tolist())
        features = dict(zip(rows.tolist(), shown(of_rows, "Finding keypoints", len(rows)), strict=True))
        of_pairs = pool.map(lambda pair: match(features[pair[0]], features[pair[1]]), pairs.tolist())
        matched = list(zip(pairs.tolist(), shown(of_pairs, "Matching images", len(pairs)), strict=True))
    first, second = (
        np.concatenate([np.empty((0, 2)), *(features[pair[side]].rays[rows[:, side]] for pair, rows in matched)])
        for side in (0, 1)
    )
    return Matches(
        pairs,
        np.repeat(np.arange(len(pairs)), [len(rows) for _, rows in matched]),
        first,
        second,
        np.array([min(_focal_px(features[row]) for row in pair) for pair in pairs.tolist()]),
        len(near),
        capture.camera_of is None,
    )


def neighbours(capture: Capture, motion: Motion) -> list[tuple[int, int]]:
    """Choose pairs by time: the farthest of the next frames that is turned little, or the nearest frame in no order."""
    position, quaternion, every = capture.world_from_cam[:, :3, 3], quaternions(capture), np.arange(len(capture.images))
    found = []
    for row in every[:: max(1, len(every) // (4 * _NEIGHBOURS))]:
        others = [row + offset for offset in _OFFSETS if row + offset < len(every)] if motion.in_order else every
        others = np.array(
            [other for other in others if capture.sequences[other] == capture.sequences[row]], dtype=np.int64
        )
        length, turn_deg = (each[0] for each in pairwise_distances(position, quaternion, every[row : row + 1], others))
        pairs = set()
        for max_turn_deg in _MAX_TURNS_DEG:
            fits = np.flatnonzero((turn_deg <= max_turn_deg) & (length >= _MIN_MOVE * motion.extent))
            if len(fits):
                place = fits[0] if motion.in_order else fits[length[fits].argmin()]
                pairs.add((int(row), int(others[place])))
        if pairs:
            found.append(sorted(pairs))
    chosen = np.linspace(0, len(found) - 1, min(_NEIGHBOURS, len(found))).round().astype(int)
    return [pair for place in chosen for pair in found[place]]


def searched(capture: Capture, row: int) -> Features:
    """The keypoints of a frame's image, made smaller where it is large."""
    image = read_image(capture.images[row])
    return detect_features(image, intrinsics(capture, row, image), LONG_SIDE_PX / max(image.shape[:2]))


def intrinsics(capture: Capture, row: int, image: Image | None = None) -> Floats:
    """The pinhole matrix of a frame, (3, 3), in pixels of its image; an assumed one where the format gives none."""
    if capture.camera_of is None:
        height, width = (read_image(capture.images[row]) if image is None else image).shape[:2]
        return assumed_intrinsics((width, height))
    camera = capture.cameras[capture.camera_of[row]]
    focal_px, center_px = camera.focal_px, camera.center_px
    return np.array([[focal_px[0], 0, center_px[0]], [0, focal_px[1], center_px[1]], [0, 0, 1]])


def _focal_px(features: Features) -> float:
    return float(features.intrinsics[0, 0]) * LONG_SIDE_PX / max(features.size)


def shown(work: Iterable[T], name: str, count: int) -> Iterator[T]:
    """The same, with a progress bar."""
    return iter(track(work, name, count, console=Console(stderr=True), transient=True))


def _by_pose(capture: Capture, near: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Pairs of nearly all baselines, of frames with depth where there are some, otherwise of those searched anyway."""
    rows = np.array(sorted({row for pair in near for row in pair}), np.int64)
    if capture.depth is not None:
        rows = np.array([row for row, file in enumerate(capture.depth.files) if file is not None], np.int64)
    rows = rows[np.linspace(0, len(rows) - 1, min(_MAX_FRAMES, len(rows))).round().astype(int)]
    if len(rows) < 2:
        return []
    return [(int(rows[one]), int(rows[other])) for one, other in pairs_by_pose(capture.world_from_cam[rows])]
