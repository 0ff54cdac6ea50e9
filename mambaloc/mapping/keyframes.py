"""Key frames: those of a capture that together cover it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mambaloc.runtime.maps.viewpoints import farthest_points, spread_m, viewpoints


def farthest_first(world_from_cam: ArrayLike, count: int) -> NDArray[np.int64]:
    """Choose key frames by coverage: each is the farthest, in position and direction, from those before it.

    The first is the one nearest to the middle of all.

    Args:
        world_from_cam: (N, 4, 4).
        count: how many, at most.

    Returns:
        Rows in ascending order, (min(count, N),).
    """
    places = viewpoints(world_from_cam, spread_m(world_from_cam))
    middle = ((places - places.mean(axis=0)) ** 2).sum(axis=1).argmin()
    return farthest_points(places, count, int(middle))
