"""Pairs of frames that see much of the same from apart, by their poses alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mambaloc.runtime.maps.viewpoints import spread_m

_MIN_MOVE, _MAX_MOVE = 0.05, 2.5  # of the cameras' spread: 3 cm to 1.5 m in a room that is filmed from its middle
_MAX_TURN_DEG = 40.0
_NEAREST, _SPREAD = 8, 8


def pairs_by_pose(world_from_cam: ArrayLike) -> NDArray[np.int64]:
    """Choose pairs of frames to match: of each frame's candidates the nearest 8, and 8 spread over the rest.

    Candidates are 0.05 to 2.5 times the cameras' spread apart, and look at most 40 degrees apart.

    Args:
        world_from_cam: (N, 4, 4), in any unit of length.

    Returns:
        Rows of frames, (P, 2), the smaller first, ordered, each pair once.
    """
    poses = np.asarray(world_from_cam, np.float64)
    unit = max(spread_m(poses), np.finfo(float).tiny)
    chosen = []
    for row in range(len(poses)):
        move = np.linalg.norm(poses[:, :3, 3] - poses[row, :3, 3], axis=1) / unit
        cosine = poses[:, :3, 2] @ poses[row, :3, 2]
        fits = (move >= _MIN_MOVE) & (move <= _MAX_MOVE) & (cosine >= np.cos(np.radians(_MAX_TURN_DEG)))
        order = np.flatnonzero(fits)[np.argsort(move[fits], kind="stable")]
        rest = order[_NEAREST:]
        spread = np.unique(np.linspace(0, len(rest) - 1, min(_SPREAD, len(rest))).round().astype(int))
        others = np.concatenate((order[:_NEAREST], rest[spread]))
        chosen.append(np.stack((np.minimum(others, row), np.maximum(others, row)), axis=1))
    return np.unique(np.concatenate(chosen), axis=0)
