"""Frames without a fix: poses that a logger or a tracker writes where it has none, and poses far off from all others.

NaN, infinity and rows of zeros are found by the readers. A position of exactly 0 0 0 may be a mark, or where a world
begins; the frames around it decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mambaloc.runtime.rotations import quaternion_from_matrix, rotation_error_deg
from mambaloc.text import natural

Floats = NDArray[np.float64]
Rows = NDArray[np.bool_]

FARTHEST = 1e9
"""Largest coordinate that a pose may have in its source's own world."""

_OUTSIDE = 2.0  # extents
_JUMP_STEPS, _JUMP_SHARE, _JUMP_DEG = 10.0, 0.02, 45.0
_LONGEST_STEP = 0.25  # of the extent, on a path
_ASTRAY = 1000.0  # extents
_BLURRED = 1e4  # from the middle: float32 is off by a thousandth there


def without_fix(world_from_cam: Floats, sequences: Sequence[str], images: Sequence[Path]) -> dict[int, str]:
    """The reason why frames have no fix, by row.

    Args:
        world_from_cam: (N, 4, 4), in the source's world.
        sequences: N names of recordings.
        images: N files, whose natural order is that in which they were taken, whatever order their poses come in.
    """
    position = world_from_cam[:, :3, 3]
    is_finite = np.isfinite(world_from_cam).all(axis=(1, 2))
    found = dict.fromkeys(np.flatnonzero(~is_finite).tolist(), "no fix: the pose is NaN, infinite or all zeros")
    is_far = is_finite & (np.abs(position) > FARTHEST).any(axis=1)
    found |= dict.fromkeys(np.flatnonzero(is_far).tolist(), f"no fix: the position is farther than {FARTHEST:g}")
    is_fixed = is_finite & ~is_far
    is_zero = is_fixed & (position == 0).all(axis=1)
    if is_zero.any() and (is_fixed & ~is_zero).sum() > 1:
        order = np.array(sorted(range(len(images)), key=lambda row: (sequences[row], natural(images[row]))))
        marks = _marks(world_from_cam[order], np.array(sequences)[order], is_zero[order], (is_fixed & ~is_zero)[order])
        found |= dict.fromkeys(order[marks].tolist(), "no fix: the position is 0 0 0, far from the frames around it")
    return found


def astray(world_from_cam: Floats) -> dict[int, str]:
    """The reason why frames lie too far off from the others to be of the same place, by row; poses (N, 4, 4)."""
    position = world_from_cam[:, :3, 3]
    if not len(position):
        return {}
    distance = np.linalg.norm(position - np.median(position, axis=0), axis=1)
    max_distance = max(_ASTRAY * float(np.quantile(distance, 0.75)), _BLURRED)
    return {
        row: f"the position is {distance[row]:.3g} from the middle of the others, over {_ASTRAY:g} times their spread"
        for row in np.flatnonzero(distance > max_distance).tolist()
    }


def _marks(world_from_cam: Floats, sequences: NDArray[np.str_], is_zero: Rows, is_fixed: Rows) -> list[int]:
    """Rows at exactly 0 0 0 that are marks: outside of the place, or where the camera cannot have gone."""
    zeros, fixed = np.flatnonzero(is_zero), np.flatnonzero(is_fixed)
    position = world_from_cam[fixed, :3, 3]
    low, high = np.percentile(position, (5, 95), axis=0)
    extent = max(float(np.linalg.norm(high - low)), 1e-12)
    if np.linalg.norm(position, axis=1).min() > _OUTSIDE * extent:
        return zeros.tolist()
    quaternion = np.full((len(world_from_cam), 4), np.nan)
    quaternion[is_zero | is_fixed] = quaternion_from_matrix(world_from_cam[is_zero | is_fixed, :3, :3])
    later = 1 + np.flatnonzero(sequences[fixed][1:] == sequences[fixed][:-1])
    step = np.median(np.linalg.norm(position[later] - position[later - 1], axis=1)) if len(later) else np.inf
    if step > _LONGEST_STEP * extent:
        _, first, count = np.unique(quaternion[zeros].round(6), axis=0, return_inverse=True, return_counts=True)
        return zeros[count[first.ravel()] > 1].tolist()
    step_deg = np.median(rotation_error_deg(quaternion[fixed[later]], quaternion[fixed[later - 1]]))
    max_step, max_step_deg = max(_JUMP_STEPS * step, _JUMP_SHARE * extent), max(_JUMP_STEPS * step_deg, _JUMP_DEG)
    marks = []
    for row in zeros.tolist():
        place = int(np.searchsorted(fixed, row))
        around = [each for each in fixed[max(place - 1, 0) : place + 1] if sequences[each] == sequences[row]]
        off = [np.linalg.norm(world_from_cam[each, :3, 3]) for each in around]
        turned_deg = [rotation_error_deg(quaternion[row], quaternion[each]) for each in around]
        if around and (min(off) > max_step or min(turned_deg) > max_step_deg):
            marks.append(row)
    return marks
