"""How far cameras are from each other, in position and direction together."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_TURN_DEG = 25.0


def spread_m(world_from_cam: ArrayLike) -> float:
    """How far cameras (N, 4, 4) are from their mean, root mean square: the scene's own unit of length."""
    position_m = np.asarray(world_from_cam, np.float64)[:, :3, 3]
    return float(np.sqrt(((position_m - position_m.mean(axis=0)) ** 2).sum(axis=1).mean()))


def farthest_points(places: Floats, count: int, first: int) -> NDArray[np.int64]:
    """Spread a choice over points: each is the farthest from those before it.

    Args:
        places: (N, D).
        count: so many at most.
        first: the row to begin with.

    Returns:
        Rows in ascending order, (min(count, N),), none twice.
    """
    chosen, nearest = [first], np.full(len(places), np.inf)
    while len(chosen) < min(count, len(places)):
        nearest = np.minimum(nearest, ((places - places[chosen[-1]]) ** 2).sum(axis=1))
        nearest[chosen] = -1
        chosen.append(int(nearest.argmax()))
    return np.sort(np.array(chosen, np.int64))


def viewpoints(world_from_cam: ArrayLike, unit_m: float) -> Floats:
    """Cameras as points whose distance counts a move by the unit as much as a turn by 25 degrees.

    A turn about the optical axis does not count: the same things are seen.

    Args:
        world_from_cam: (N, 4, 4).
        unit_m: the scene's :func:`spread_m`, in which the points are.

    Returns:
        (N, 6): position, and the direction of view as long as makes a chord what it counts.
    """
    poses = np.asarray(world_from_cam, np.float64)
    return np.hstack((poses[:, :3, 3] / max(unit_m, 1e-12), poses[:, :3, 2] / np.radians(_TURN_DEG)))
