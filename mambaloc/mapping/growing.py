"""Grow a sparse map by new frames, and take them out again; what stands in the map does not move."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.mapping.building import epipolar_px, keypoint_tracks, points_of_tracks
from mambaloc.mapping.bundle_adjustment import Prior, adjust
from mambaloc.mapping.keyframes import farthest_first
from mambaloc.mapping.pairs import pairs_by_pose
from mambaloc.mapping.tracks import match_pair
from mambaloc.mapping.triangulation import Observations, residuals, triangulate
from mambaloc.runtime.maps import CameraPose, MapLocaliser, SparseMap
from mambaloc.runtime.maps.features import Features, quantized
from mambaloc.runtime.maps.viewpoints import spread_m
from mambaloc.runtime.rotations import matrix_from_quaternion

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

_FARTHEST, _FARTHEST_DEG = 0.25, 15.0  # of the key frames' spread; by how much a given pose may be off
_LEAST_AGREEING = 0.3  # of matches between new frames
_WIDTHS = (1,)
_GIVEN_DEG = 1.0  # deviation of given poses


@dataclass(frozen=True)
class NewFrame:
    """A frame to add to a map.

    Args:
        name: of its file, or its number in a film.
        features: its keypoints, as :meth:`~mambaloc.runtime.maps.MapLocaliser.features` finds them.
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
        lost: names of the frames that were not localised, or whose given pose says otherwise.
        rounds: how often the frames were localised, each time in the map that those before had made.
    """

    sparse_map: SparseMap
    key_frames: list[str]
    lost: list[str]
    rounds: int


def add_frames(sparse_map: SparseMap, frames: Sequence[NewFrame], session: str, most: int) -> Growth:
    """Localise frames in a map, make key frames of those found, and triangulate what these add.

    A frame may be found only once its neighbours were added, so that is repeated until nothing more is found. Keypoints
    that show no point of the map are matched between the new key frames, whose poses are adjusted to all that they see.

    Args:
        sparse_map: the map.
        frames: what to add.
        session: a name by which :func:`remove_session` removes all of it.
        most: key frames to add; they are spread over the poses found.

    Raises:
        InputError: for a session that the map has already, where no frame is found, or where all poses contradict
            those given.
    """
    if session in sparse_map.sessions:
        raise InputError(f"{session}: was added before. Remove that first, or add these under another --name.")
    poses: dict[int, CameraPose] = {}
    grown, key, rounds, contradict = sparse_map, [], 0, 0
    while True:
        found, contradict = _found(grown, frames, [row for row in range(len(frames)) if row not in poses])
        rounds += 1
        if not found:
            break
        poses |= found
        grown, key = _grown(sparse_map, frames, poses, session, most)
    if not poses:
        raise InputError(_why_none(session, len(frames), contradict))
    lost = [frame.name for row, frame in enumerate(frames) if row not in poses]
    return Growth(grown, [frames[row].name for row in key], lost, rounds)


def _found(sparse_map: SparseMap, frames: Sequence[NewFrame], rows: list[int]) -> tuple[dict[int, CameraPose], int]:
    """Poses of those frames that the map finds, and how many it finds elsewhere than they were given."""
    localiser, unit_m = MapLocaliser(sparse_map), spread_m(sparse_map.key_poses)
    found, contradict = {}, 0
    for row in rows:
        given = frames[row].given
        located = localiser.localise_features(frames[row].features, given)
        if located.is_accepted:
            pose = CameraPose(matrix_from_quaternion(located.quaternion), located.position_m)
            if given is None or _agree(pose, given, unit_m):
                found[row] = pose
            else:
                contradict += 1
    return found, contradict


def remove_session(sparse_map: SparseMap, session: str) -> SparseMap:
    """Remove the key frames that were added under a name, and the points that no other key frame sees.

    Where nothing was added since, this is the map as it was before, bit for bit.

    Raises:
        InputError: where the map has no such session.
    """
    if session not in sparse_map.sessions:
        names = ", ".join(sparse_map.sessions) or "nothing"
        raise InputError(f"{session}: was never added to the map of {sparse_map.scene}. What was added: {names}.")
    names = list(sparse_map.sessions)
    later = sum(sparse_map.sessions[name] for name in names[names.index(session) + 1 :])
    end = len(sparse_map.key_poses) - later
    gone = np.arange(end - sparse_map.sessions[session], end)
    is_seen = np.delete(sparse_map.is_seen, gone, axis=1)
    kept = is_seen.any(axis=1)
    return replace(
        sparse_map,
        points_m=sparse_map.points_m[kept],
        descriptors=sparse_map.descriptors[kept],
        views=np.packbits(is_seen[kept], axis=1),
        key_poses=np.delete(sparse_map.key_poses, gone, axis=0),
        digests=_without(sparse_map.digests, session),
        sessions=_without(sparse_map.sessions, session),
    )


def _grown(
    sparse_map: SparseMap, frames: Sequence[NewFrame], poses: dict[int, CameraPose], session: str, most: int
) -> tuple[SparseMap, list[int]]:
    """The map with frames whose poses are known, and which became key frames; their poses are adjusted in place."""
    rows = np.array(sorted(poses))
    key = rows[farthest_first(np.stack([poses[row].matrix for row in rows]), most)].tolist()
    new = [frames[row] for row in key]
    localiser = MapLocaliser(sparse_map)
    for width in _WIDTHS:
        seen, _, _, known, cam_from_world = _seen(localiser, new, [poses[row] for row in key], width)
        adjusted = np.linalg.inv(_adjusted(sparse_map, new, known, cam_from_world, seen))
        poses |= {row: CameraPose(pose[:3, :3], pose[:3, 3]) for row, pose in zip(key, adjusted, strict=True)}
    seen, keypoint, rest, known, cam_from_world = _seen(localiser, new, [poses[row] for row in key], 1)
    points_m, descriptors, seen_by_new = points_of_tracks(
        rest, cam_from_world, seen, keypoint, np.random.default_rng(0)
    )
    order = np.argsort(-seen_by_new.sum(axis=1), kind="stable")
    known_by_new = np.zeros((len(sparse_map), len(key)), bool)
    for column, (_, points) in enumerate(known):
        known_by_new[points, column] = True
    old = np.concatenate((sparse_map.is_seen, known_by_new), axis=1)
    added = np.concatenate((np.zeros((len(order), len(sparse_map.key_poses)), bool), seen_by_new[order]), axis=1)
    world_from_cam = np.linalg.inv(cam_from_world)
    grown = replace(
        sparse_map,
        points_m=np.concatenate((sparse_map.points_m, points_m[order].astype(np.float32))),
        descriptors=np.concatenate((sparse_map.descriptors, quantized(descriptors[order]))),
        views=np.packbits(np.concatenate((old, added)), axis=1),
        key_poses=np.concatenate((sparse_map.key_poses, world_from_cam)),
        digests={**sparse_map.digests, session: hashlib.sha256(world_from_cam.tobytes()).hexdigest()},
        sessions={**sparse_map.sessions, session: len(key)},
    )
    return grown, key


def _seen(localiser, new, poses, width):
    known = [localiser.matches(frame.features, pose) for frame, pose in zip(new, poses, strict=True)]
    rest = [
        frame.features.select(np.setdiff1d(np.arange(len(frame.features)), keypoints))
        for frame, (keypoints, _) in zip(new, known, strict=True)
    ]
    cam_from_world = np.linalg.inv([pose.matrix for pose in poses])
    seen, keypoint = _tracks(rest, cam_from_world, width * epipolar_px(localiser.map.size[0]))
    return seen, keypoint, rest, known, cam_from_world


def _tracks(features: Sequence[Features], cam_from_world: Floats, near: float) -> tuple[Observations, Indices]:
    """What the frames see together; pairs whose matches mostly disagree with the poses are left out."""
    found = [
        (pair, *match_pair(features, cam_from_world, pair, near))
        for pair in pairs_by_pose(np.linalg.inv(cam_from_world))
    ]
    agreeing = [(pair, rows) for pair, rows, tried in found if len(rows) > _LEAST_AGREEING * tried]
    pairs = np.array([pair for pair, _ in agreeing], np.int64).reshape(-1, 2)
    return keypoint_tracks(features, pairs, [np.empty((0, 2), np.int64), *(rows for _, rows in agreeing)][1:], near)


def _adjusted(
    sparse_map: SparseMap,
    new: Sequence[NewFrame],
    known: Sequence[tuple[Indices, Indices]],
    cam_from_world: Floats,
    seen: Observations,
) -> Floats:
    """Poses of the new frames, ``cam_from_world``, adjusted to the map's points, which stay, and to new ones."""
    points, is_point, agrees = triangulate(cam_from_world, seen, np.random.default_rng(0))
    used = agrees & is_point[seen.track]
    frame = np.concatenate([seen.frame[used], *(np.full(len(rows), column) for column, (rows, _) in enumerate(known))])
    track = np.concatenate([seen.track[used], *(len(points) + rows for _, rows in known)])
    rays = np.concatenate(
        [seen.rays[used], *(each.features.rays[rows] for each, (rows, _) in zip(new, known, strict=True))]
    )
    near = epipolar_px(sparse_map.size[0]) / sparse_map.intrinsics[0, 0]
    order = np.argsort(track, kind="stable")
    every = Observations(frame[order], track[order], rays[order], np.full(len(order), near))
    places = np.concatenate((points, sparse_map.points_m))[np.unique(track)]
    is_fixed = np.unique(track) >= len(points)
    if all(each.given is not None for each in new):
        given = np.linalg.inv([each.given.matrix for each in new])
        turn = np.radians(_GIVEN_DEG)
        prior = Prior(turn, turn * float(np.median(np.linalg.norm(places - sparse_map.key_poses[0, :3, 3], axis=1))))
    else:
        given, prior = cam_from_world, Prior(np.pi, 10 * spread_m(sparse_map.key_poses))
    every = every.renumbered()
    every = every.as_near_as(residuals(cam_from_world, every, places))
    return adjust(cam_from_world, every, places, prior, given=given, fixed=is_fixed)[0]


def _agree(pose: CameraPose, given: CameraPose, unit_m: float) -> bool:
    cosine = (np.trace(pose.rotation.T @ given.rotation) - 1) / 2
    off_m = np.linalg.norm(pose.position_m - given.position_m)
    return bool(off_m <= _FARTHEST * unit_m and cosine >= np.cos(np.radians(_FARTHEST_DEG)))


def _why_none(session: str, frames: int, contradict: int) -> str:
    if contradict:
        return (
            f"{session}: its poses contradict the map, which finds {contradict} of {frames} frames elsewhere. "
            "Give the pictures' folder, without poses."
        )
    return (
        f"{session}: the map finds none of {frames} frames. Check that they show the same place and that --intrinsics "
        "are theirs, and start filming where the map was built."
    )


def _without(names: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in names.items() if key != name}
