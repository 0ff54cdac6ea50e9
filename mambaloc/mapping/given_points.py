"""Structure from points that were given, such as those of a COLMAP model: nothing is triangulated again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mambaloc.mapping.structure import Structure, mean_descriptors
from mambaloc.mapping.triangulation import Observations
from mambaloc.runtime.maps.features import Features
from mambaloc.runtime.maps.lens import Lens

if TYPE_CHECKING:
    from mambaloc.data.tracks import Tracks  # whose package needs torch

Floats = NDArray[np.floating[Any]]

_NEAR_PX = 1.0  # from a keypoint to where a point is seen, in pixels of an image of 160


def described(tracks: Tracks, features: Sequence[Features], world_from_cam: Floats) -> Structure:
    """Describe points by the keypoints that are nearest to where frames see them; those without any are left out.

    Args:
        tracks: points, and where frames see them.
        features: of each frame.
        world_from_cam: (N, 4, 4), in which the points are; kept as it is.
    """
    near = _NEAR_PX * features[0].size[0] / 160 / features[0].intrinsics[0, 0]
    first = np.cumsum([0, *(len(each) for each in features)])
    keypoint = np.full(len(tracks.frame), -1)
    distance = np.full(len(tracks.frame), np.inf)
    for frame, each in enumerate(features):
        rows = np.flatnonzero(tracks.frame == frame)
        if len(each) and len(rows):
            distance[rows], nearest = cKDTree(each.rays).query(tracks.rays[rows])
            keypoint[rows] = first[frame] + nearest
    order = np.argsort(distance, kind="stable")
    used = np.zeros(len(order), bool)
    used[order[np.unique(keypoint[order], return_index=True)[1]]] = True  # a keypoint shows one point, the nearest
    used = np.flatnonzero(used & (distance <= near))
    used = used[np.argsort(tracks.point[used], kind="stable")]
    rows, track = np.unique(tracks.point[used], return_inverse=True)
    seen = Observations(tracks.frame[used], track, tracks.rays[used], np.full(len(used), near))
    descriptors = mean_descriptors(features, len(rows), seen, keypoint[used])
    return Structure(world_from_cam, (Lens(),), tracks.points_m[rows], descriptors, seen, 1.0)
