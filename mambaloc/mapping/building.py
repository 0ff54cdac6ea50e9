"""A sparse map from posed frames: key frames, keypoints, matches, tracks, points, descriptors."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mambaloc.console import progress
from mambaloc.errors import InputError
from mambaloc.images import Image
from mambaloc.mapping.choosing import bytes_each, most_useful
from mambaloc.mapping.given_points import described
from mambaloc.mapping.kept_parts import image_name, kept_keypoints, kept_matches
from mambaloc.mapping.keyframes import farthest_first
from mambaloc.mapping.pairs import pairs_by_pose
from mambaloc.mapping.structure import Structure, recover_structure
from mambaloc.runtime.maps.drift import fit_drift
from mambaloc.runtime.maps.features import Features, quantized
from mambaloc.runtime.maps.sparse_map import SparseMap
from mambaloc.runtime.undistortion import Undistortion
from mambaloc.runtime.world import World

if TYPE_CHECKING:
    from mambaloc.data.tracks import Tracks  # whose package needs torch

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]
_MIN_KEYPOINTS = 20
_MIN_AGREEING = 0.3  # of matches; a tenth agree with any pose by chance

POINTS = ("triangulated", COLMAP := "colmap")
"""Values of :attr:`MapSettings.points`."""
COLMAP_POINTS = "points of COLMAP"
"""Name of the digest that a map with the points of a COLMAP model has."""

T = TypeVar("T")
S = TypeVar("S")


@dataclass(frozen=True)
class PosedFrames:
    """Frames with their cameras and poses.

    Shape:
        ``images`` N paths or RGB arrays (H, W, 3); ``intrinsics`` (N, 3, 3) in pixels of each; ``world_from_cam``
        (N, 4, 4).

    Args:
        tracks: points that structure from motion found with these poses, and where the frames see them.
        world: where the scene's frame lies in the world of the data that it was made of.
        undistortion: how the images were made of what their camera stored.
    """

    images: Sequence[Path | Image]
    intrinsics: NDArray[np.float64]
    world_from_cam: NDArray[np.float64]
    tracks: Tracks | None = None
    world: World = field(default_factory=World)
    undistortion: Undistortion = field(default_factory=Undistortion)

    def __len__(self) -> int:
        return len(self.images)

    def select(self, rows: Indices) -> PosedFrames:
        """The frames of these rows."""
        return PosedFrames(
            [self.images[row] for row in rows],
            self.intrinsics[rows],
            self.world_from_cam[rows],
            self.tracks and self.tracks.of_frames(rows),
            self.world,
            self.undistortion,
        )


@dataclass(frozen=True)
class MapSettings:
    """How a map is built.

    Args:
        key_frames: how many, at most.
        width: of the images in which keypoints are searched, in pixels; narrower ones are searched as they are.
        most_bytes: budget of points and descriptors.
        least_inliers: how many inliers a pose needs to be accepted.
        seed: of the views that triangulation draws.
        points: ``triangulated`` from our own matches; or ``colmap``, as an imported COLMAP model has them, where there
            is one, in a third of the time. Measured on a rendered room (80 key frames at 240 px): where COLMAP
            reconstructed the training frames alone, other frames are 0.0065 m (worst 0.016) off their true poses with
            our own points, 0.0070 m (worst 0.075) with COLMAP's. Where it reconstructed held-out frames, too, COLMAP's
            are nearer to the poses that it gave these: in the mean 0.040 instead of 0.098 units.
    """

    key_frames: int = 160
    width: int = 320
    most_bytes: int = 4 * 2**20
    least_inliers: int = 20
    seed: int = 0
    points: str = "triangulated"


def build_map(frames: PosedFrames, settings: MapSettings, scene: str, threads: int | None = None) -> SparseMap:
    """Build a map from posed frames.

    Args:
        frames: candidates for key frames.
        settings: how the map is built.
        scene: name of the place.
        threads: to decode, search and match with; one per core unless given. The result does not depend on it.

    Raises:
        InputError: where there are too few frames, too little texture or parallax, or poses that the images contradict;
            or an image is bad.
    """
    if len(frames) < 2:
        raise InputError(
            f"{scene}: triangulation needs two frames or more, but it has {len(frames)}. "
            "Give more, taken from different places."
        )
    key = frames.select(farthest_first(frames.world_from_cam, settings.key_frames))
    tracks = key.tracks if settings.points == COLMAP else None
    pairs = np.empty((0, 2), np.int64) if tracks else _pairs(scene, key)
    features, matches = _searched(scene, key, pairs, settings.width, threads or os.cpu_count())
    if tracks:
        structure = described(tracks, features, key.world_from_cam)
    else:
        structure = recover_structure(
            features, key.world_from_cam, pairs, matches, np.random.default_rng(settings.seed)
        )
    _check_enough(scene, structure, settings.least_inliers)
    max_points = settings.most_bytes // bytes_each(len(key))
    camera = features[0]
    drift, nugget = fit_drift(structure.world_from_cam, key.world_from_cam)
    kept = most_useful(structure.seen, len(structure.points_m), max_points, camera.size[0] / camera.intrinsics[0, 0])
    return SparseMap(
        structure.points_m[kept].astype(np.float32),
        quantized(structure.descriptors[kept]),
        np.packbits(structure.views[kept], axis=1),
        structure.world_from_cam.astype(np.float64),
        camera.size,
        camera.intrinsics,
        settings.least_inliers,
        scene,
        _digests(frames, tracks),
        structure.lenses[0],
        np.zeros((0, 6)) if tracks else drift,
        nugget,
        world=frames.world,
        undistortion=frames.undistortion,
    )


def describe_points(sparse_map: SparseMap) -> str:
    """How many points a map has, and where they come from, in one line."""
    return f"points {'from COLMAP' if COLMAP_POINTS in sparse_map.digests else 'triangulated'}: {len(sparse_map)}"


def _digests(frames: PosedFrames, tracks: Tracks | None) -> dict[str, str]:
    """Digests of the poses, and of the points of a COLMAP model where they are used."""
    digests = {"poses": hashlib.sha256(frames.world_from_cam.tobytes() + frames.intrinsics.tobytes()).hexdigest()}
    if tracks:
        digests[COLMAP_POINTS] = hashlib.sha256(tracks.points_m.tobytes() + tracks.rays.tobytes()).hexdigest()
    return digests


def _pairs(scene: str, key: PosedFrames) -> Indices:
    pairs = pairs_by_pose(key.world_from_cam)
    if not len(pairs):
        raise InputError(
            f"{scene}: no two of {len(key)} key frames look in a similar direction from different places. "
            "Film while walking, not turning."
        )
    return pairs


def _searched(
    scene: str, key: PosedFrames, pairs: Indices, width: int, threads: int | None
) -> tuple[list[Features], list[Indices]]:
    """Keypoints of key frames, and the matches of each pair; pairs are ordered by their first frame."""
    names = [image_name(image, width) for image in key.images]
    others = np.split(pairs[:, 1], np.searchsorted(pairs[:, 0], np.arange(1, len(key))))

    def searched(row: int) -> Features:
        return kept_keypoints(key.images[row], width, names[row]).described(key.intrinsics[row])

    def matched(row: int) -> list[Indices]:
        rows = [row, *others[row]]
        return kept_matches([features[each] for each in rows], [names[each] for each in rows])

    with ThreadPoolExecutor(threads) as pool:
        features = _each(pool, searched, range(len(key)), "keypoints")
        if (keypoints := np.median([len(each) for each in features])) < _MIN_KEYPOINTS:
            raise InputError(
                f"{scene}: its frames have {keypoints:.0f} keypoints each. "
                "Film surfaces with more texture, or give larger images and a larger width."
            )
        matches = _each(pool, matched, range(len(key)), "matches")
    return features, list(itertools.chain.from_iterable(matches))


def _each(pool: ThreadPoolExecutor, work: Callable[[S], T], items: Sequence[S], name: str) -> list[T]:
    return list(progress(pool.map(work, items), name, len(items)))


def _check_enough(scene: str, structure: Structure, min_points: int) -> None:
    if structure.agreeing < _MIN_AGREEING:
        raise InputError(
            f"{scene}: {100 * structure.agreeing:.0f} % of the matches between its frames agree with their poses. "
            "Check that poses and intrinsics belong to the images."
        )
    if (points := len(structure.points_m)) < min_points:
        raise InputError(f"{scene}: its frames give {points} points. Give more frames, taken from further apart.")
