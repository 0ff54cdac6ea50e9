"""Where a camera would find itself in a sparse map, and where it would be lost."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.runtime.maps import SparseMap
from mambaloc.runtime.maps.viewpoints import spread_m

Floats = NDArray[np.floating[Any]]

# Chosen on rendered rooms and on held-out blocks of redkitchen: they rank which frames are found, see the tests.
_LIKE_DEG, _LIKE_OCTAVES = 18.0, 0.7  # a point looks like itself from so far around, and from 2^0.7 times as near
_SHARE = 0.25  # of the points that look alike, which are matched
_OFF_PX = 0.5
_MIN_PROBABILITY = 0.02
_OCTAVES = 3.0  # of matches, or of the deviation, from lost to sure
_UNSURE = 2.0  # times the matches that a pose needs: half of the frames that expect so many are found
_MAX_DEVIATION = 0.03  # of the key frames' spread


class Outlook:
    """What cameras would see of a map's points.

    A point counts the less, the more differently a key frame saw it: by the angle between the two lines of sight, and
    by their lengths. What is expected to be matched fixes the pose as bearings with an error of half a pixel do.

    Args:
        sparse_map: the map.
    """

    def __init__(self, sparse_map: SparseMap) -> None:
        self.map = sparse_map
        self._points_m = sparse_map.points_m.astype(np.float64)
        self._point, frame = np.nonzero(sparse_map.is_seen)
        towards = sparse_map.key_poses[frame, :3, 3] - self._points_m[self._point]
        self._depth_m = np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
        self._towards = towards / self._depth_m[:, None]
        self._first = np.flatnonzero(np.diff(self._point, prepend=-1))

    def of(self, position_m: Floats, rotations: Floats) -> tuple[Floats, Floats]:
        """What cameras at one place see.

        Args:
            position_m: (3,).
            rotations: ``world_from_cam``, (N, 3, 3).

        Returns:
            How many points a camera may be expected to match, (N,), and the standard deviation in metres of its
            position, in the direction that is least sure, (N,); infinite where the points leave it open.
        """
        towards = self._points_m - position_m
        depth_m = np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
        towards /= depth_m[:, None]
        chance = self._chance(towards, depth_m)
        near = np.flatnonzero(chance > _MIN_PROBABILITY)
        counts = _SHARE * chance[near] * self._is_inside(towards[near], rotations)
        normal = (counts @ _information(towards[near], depth_m[near])).reshape(-1, 6, 6)
        return counts.sum(axis=1), _deviation_m(normal) * _OFF_PX / float(self.map.intrinsics[0, 0])

    def certainty(self, matches: Floats, deviation_m: Floats) -> Floats:
        """What :meth:`of` returns as one number from 0, lost, to 1, sure; at 0.5 every second camera is found."""
        enough = np.log2(np.maximum(matches, 1e-9) / (_UNSURE * self.map.least_inliers))
        allowed = _MAX_DEVIATION * spread_m(self.map.key_poses)
        precise = np.log2(allowed / np.clip(deviation_m, 1e-12, 1e12))
        return np.clip(0.5 + np.minimum(enough, precise) / _OCTAVES, 0, 1)

    def _chance(self, towards: Floats, depth_m: Floats) -> Floats:
        """How likely each point is matched from there, if it is in view, (P,)."""
        cosine = -(towards[self._point] * self._towards).sum(axis=1)
        turn = np.degrees(np.arccos(np.clip(cosine, -1, 1))) / _LIKE_DEG
        octaves = np.log2(depth_m[self._point] / self._depth_m) / _LIKE_OCTAVES
        return np.maximum.reduceat(np.exp(-(turn**2) - octaves**2), self._first)

    def _is_inside(self, towards: Floats, rotations: Floats) -> NDArray[np.bool_]:
        """Which directions (P, 3) each image shows, (N, P)."""
        cam = np.einsum("pi,nij->jnp", towards, rotations)
        (fx, fy), (cx, cy) = np.diag(self.map.intrinsics)[:2], self.map.intrinsics[:2, 2]
        x, y, depth = fx * cam[0], fy * cam[1], cam[2]
        width, height = self.map.size
        across = (x >= -(cx + 0.5) * depth) & (x <= (width - 0.5 - cx) * depth)
        return across & (y >= -(cy + 0.5) * depth) & (y <= (height - 0.5 - cy) * depth) & (depth > 0)


def _information(towards: Floats, depth_m: Floats) -> Floats:
    """Information ``J^T J`` about position and rotation in a bearing with an error of one radian, (P, 36)."""
    across = np.eye(3) - towards[:, :, None] * towards[:, None]
    turned = np.cross(towards[:, None], np.eye(3)[None])  # row k is towards x e_k, what a turn about e_k does
    jacobian = np.concatenate((-across / depth_m[:, None, None], turned.transpose(0, 2, 1)), axis=2)
    return np.einsum("pki,pkj->pij", jacobian, jacobian).reshape(-1, 36)


def _deviation_m(normal: Floats) -> Floats:
    """Of positions, in the direction that is least sure, from normal equations (N, 6, 6)."""
    place, both, turn = normal[:, :3, :3], normal[:, :3, 3:], normal[:, 3:, 3:]
    left = place - both @ np.linalg.pinv(turn, hermitian=True) @ both.transpose(0, 2, 1)
    min_eigenvalue = np.linalg.eigvalsh(left)[:, 0]
    return np.where(min_eigenvalue > 1e-9, 1 / np.sqrt(np.maximum(min_eigenvalue, 1e-9)), np.inf)
