"""Add frames to a sparse map and remove them again; the points and key frames that it has do not move."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.mapping.choosing import bytes_each
from mambaloc.mapping.extending import extend
from mambaloc.mapping.keyframes import farthest_first
from mambaloc.mapping.tracks import match
from mambaloc.runtime.maps import CameraPose, MapLocalizer, SparseMap
from mambaloc.runtime.maps.drift import drift_moves, drift_weights, known_moves
from mambaloc.runtime.maps.features import Features, quantized
from mambaloc.runtime.maps.viewpoints import spread_m

Floats = NDArray[np.floating[Any]]

_MAX_NAMED = 8
# Times the inliers that an answer needs: a wrong pose that is built on misleads later ones, and a frame that has few of
# them has more once its neighbours were added.
_INLIERS = 3
_FARTHEST, _FARTHEST_DEG = 0.25, 15.0  # of the key frames' spread; by how much a given pose may be off


@dataclass(frozen=True)
class NewFrame:
    """A frame to add to a map.

    Args:
        name: of its file, or its number in a video.
        features: its keypoints, as :meth:`~mambaloc.runtime.maps.MapLocalizer.features` finds them.
        given: its pose in the map's world, where it is known.
    """

    name: str
    features: Features
    given: CameraPose | None = None


@dataclass(frozen=True)
class Growth:
    """A map that has grown.

    Args:
        sparse_map: the map; its first points and key frames are those of the map before, bit for bit.
        key_frames: names of those that became key frames.
        lost: names of the frames that were not localized, or whose given pose says otherwise.
        rounds: how often the frames were localized, each time in the map that those before had made.
    """

    sparse_map: SparseMap
    key_frames: list[str]
    lost: list[str]
    rounds: int

    def describe(self, points_before: int) -> str:
        """One line, and one with the names of lost frames where there are any."""
        text = (
            f"{len(self.key_frames)} key frames and {len(self.sparse_map) - points_before} points added, "
            f"in {self.rounds} rounds; {len(self.sparse_map)} points in all"
        )
        if self.lost:
            more = f" and {len(self.lost) - _MAX_NAMED} more" if len(self.lost) > _MAX_NAMED else ""
            text += f"\nnot found in the map: {len(self.lost)} frames, {', '.join(self.lost[:_MAX_NAMED])}{more}"
        return text


def add_frames(
    sparse_map: SparseMap, frames: Sequence[NewFrame], session: str, most: int, most_bytes: int = 4 * 2**20
) -> Growth:
    """Localize frames in a map, make key frames of those found, and triangulate what these add.

    A frame may be found only once its neighbours were added, so that is repeated until nothing more is found. Keypoints
    that show no point of the map are matched between the new key frames, whose poses are adjusted to all that they see.

    Args:
        sparse_map: the map.
        frames: what to add.
        session: name of the addition, for :func:`remove_session`.
        most: how many key frames to add, at most; they are spread over the poses found.
        most_bytes: budget of the points and descriptors that are added.

    Raises:
        InputError: for a session that the map has already or a name that it uses itself, where no frame is found, or
            where all poses contradict those given.
    """
    if session in sparse_map.sessions:
        raise InputError(f"{session}: is in the map already. Remove it first, or choose another --name.")
    if session in sparse_map.digests:
        raise InputError(f"{session}: is the name of the map's own frames. Choose another --name.")
    matched = functools.cache(lambda first, second: match(frames[first].features, frames[second].features))
    poses: dict[int, CameraPose] = {}
    grown, rounds, contradict = sparse_map, 0, 0
    key: list[int] = []
    while True:
        found, contradict = _found(grown, frames, [row for row in range(len(frames)) if row not in poses])
        rounds += 1
        if not found:
            break
        poses |= found
        grown, key = _grown(sparse_map, frames, matched, poses, session, most, most_bytes)
    if not poses:
        raise InputError(_why_none(session, len(frames), contradict))
    lost = [frame.name for row, frame in enumerate(frames) if row not in poses]
    return Growth(grown, [frames[row].name for row in key], lost, rounds)


def remove_session(sparse_map: SparseMap, session: str) -> SparseMap:
    """Remove the key frames that were added under a name, and the points that no other key frame sees.

    Where nothing was added since, this is the map as it was before, bit for bit.

    Raises:
        InputError: where the map has no such session.
    """
    if session not in sparse_map.sessions:
        added = ", ".join(sparse_map.sessions) or "none"
        raise InputError(f"{session}: is not in the map of {sparse_map.scene}. Choose one of its sessions: {added}.")
    names = list(sparse_map.sessions)
    later = sum(sparse_map.sessions[name] for name in names[names.index(session) + 1 :])
    end = len(sparse_map.key_poses) - later
    gone = np.arange(end - sparse_map.sessions[session], end)
    key_poses = np.delete(sparse_map.key_poses, gone, axis=0)
    is_seen = np.delete(sparse_map.is_seen, gone, axis=1)
    kept = is_seen.any(axis=1)
    drift, first_drift = _drift(sparse_map, key_poses, np.delete(_moves(sparse_map), gone, axis=0))
    return replace(
        sparse_map,
        points_m=sparse_map.points_m[kept],
        descriptors=sparse_map.descriptors[kept],
        views=np.packbits(is_seen[kept], axis=1),
        key_poses=key_poses,
        digests=_without(sparse_map.digests, session),
        sessions=_without(sparse_map.sessions, session),
        drift=drift,
        first_drift=first_drift,
    )


def _found(sparse_map: SparseMap, frames: Sequence[NewFrame], rows: list[int]) -> tuple[dict[int, CameraPose], int]:
    """Poses of the frames that the map finds, in its own frame, and how many contradict those given."""
    localizer, unit_m = MapLocalizer(sparse_map), spread_m(sparse_map.key_poses)
    found, contradict = {}, 0
    for row in rows:
        given = frames[row].given
        located = localizer.localize_features(frames[row].features, given)
        if located.is_accepted and located.inliers >= _INLIERS * sparse_map.least_inliers:
            pose = CameraPose.from_quaternion(located.quaternion, located.position_m)
            if given is None or _agree(pose, given, unit_m):
                found[row] = localizer.drift.to_adjusted(pose)
            else:
                contradict += 1
    return found, contradict


def _grown(
    sparse_map: SparseMap,
    frames: Sequence[NewFrame],
    matched: Callable[[int, int], NDArray[np.int64]],
    poses: dict[int, CameraPose],
    session: str,
    max_key_frames: int,
    most_bytes: int,
) -> tuple[SparseMap, list[int]]:
    """The map with frames whose poses are known, and which became key frames; their poses are adjusted in place."""
    rows = np.array(sorted(poses))
    key = rows[farthest_first(np.stack([poses[row].matrix for row in rows]), max_key_frames)].tolist()
    localizer = MapLocalizer(sparse_map)
    given = [pose for row in key if (pose := frames[row].given) is not None]
    is_given = len(given) == len(key)
    new = extend(
        localizer,
        [frames[row].features for row in key],
        lambda first, second: matched(key[first], key[second]),
        np.stack([poses[row].matrix for row in key]),
        np.stack([localizer.drift.to_adjusted(pose).matrix for pose in given]) if is_given else None,
        most_bytes // bytes_each(len(sparse_map.key_poses) + len(key)),
    )
    for row, pose in zip(key, new.world_from_cam, strict=True):
        poses[row] = CameraPose(pose[:3, :3], pose[:3, 3])
    unseen = np.zeros((len(new.points_m), len(sparse_map.key_poses)), bool)
    views = np.block([[sparse_map.is_seen, new.views], [unseen, new.new_views]])
    key_poses = np.concatenate((sparse_map.key_poses, new.world_from_cam)).astype(np.float64)
    moves = np.full((len(key), 6), np.nan)
    if is_given:
        moves = drift_moves(new.world_from_cam, np.stack([pose.matrix for pose in given]))
    drift, first_drift = _drift(sparse_map, key_poses, np.concatenate((_moves(sparse_map), moves)))
    grown = replace(
        sparse_map,
        points_m=np.concatenate((sparse_map.points_m, new.points_m.astype(np.float32))),
        descriptors=np.concatenate((sparse_map.descriptors, quantized(new.descriptors))),
        views=np.packbits(views, axis=1),
        key_poses=key_poses,
        digests={**sparse_map.digests, session: hashlib.sha256(new.world_from_cam.tobytes()).hexdigest()},
        sessions={**sparse_map.sessions, session: len(key)},
        drift=drift,
        first_drift=first_drift,
    )
    return grown, key


def _moves(sparse_map: SparseMap) -> Floats:
    """From adjusted to given poses, of each key frame (K, 6); NaN where none was given."""
    moves = np.full((len(sparse_map.key_poses), 6), np.nan)
    moves[: _first(sparse_map)] = 0  # of a map whose frame is its own
    if known := len(sparse_map.drift):
        moves[:known] = known_moves(sparse_map.key_poses[:known], sparse_map.drift, sparse_map.nugget)
    return moves


def _drift(sparse_map: SparseMap, key_poses: Floats, moves: Floats) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The drift of a map once it has other key frames, and that of the first ones alone, which is kept bit for bit."""
    first = _first(sparse_map)
    alone = sparse_map.first_drift if sparse_map.has_grown_drift else sparse_map.drift
    known = 1 + int(np.flatnonzero(np.isfinite(moves[:, 0]))[-1])
    if known <= first:
        return alone, np.zeros((0, 6))
    return drift_weights(key_poses[:known], moves[:known], sparse_map.nugget), alone


def _first(sparse_map: SparseMap) -> int:
    """How many key frames the map was built from."""
    return len(sparse_map.key_poses) - sum(sparse_map.sessions.values())


def _agree(pose: CameraPose, given: CameraPose, unit_m: float) -> bool:
    cosine = (np.trace(pose.rotation.T @ given.rotation) - 1) / 2
    off_m = np.linalg.norm(pose.position_m - given.position_m)
    return bool(off_m <= _FARTHEST * unit_m and cosine >= np.cos(np.radians(_FARTHEST_DEG)))


def _why_none(session: str, frames: int, contradict: int) -> str:
    if contradict:
        return (
            f"{session}: its poses contradict the map, which finds {contradict} of {frames} frames elsewhere. "
            "Give the images' folder, without poses."
        )
    return (
        f"{session}: the map finds none of {frames} frames. Check that they show the same place and that --intrinsics "
        "are theirs, and start filming where the map was built."
    )


def _without(names: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in names.items() if key != name}
