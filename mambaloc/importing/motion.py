"""How a capture's camera moved from frame to frame, and how far apart any two frames are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from mambaloc.importing.capture import Capture
from mambaloc.runtime.rotations import degrees_of_chords, quaternion_from_matrix, rotation_error_deg

Floats = NDArray[np.float64]

_JUMP_STEPS = 10.0
_JUMP_SHARE = 0.02  # of the extent: a camera that hardly moves makes no jumps
_JUMP_DEG = 45.0
_LONGEST_STEP = 0.25  # of the extent: a path's steps are shorter; two frames drawn at random lie farther apart
_MIN_STEP = 1e-4  # of the extent
_MIN_DEG = 0.05
_PAIRS_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class Motion:
    """Steps from each frame to the next of its sequence.

    Args:
        later: (M,), the row of each step's second frame.
        length: (M,), in the capture's unit.
        turn_deg: (M,).
        extent: length of the diagonal of the box that holds nine tenths of the camera centres along each axis.
        step: how far neighbours are apart: the median step, or, where frames come in no order, the median distance to
            the nearest frame.
        step_deg: the same of view directions.
        in_order: whether the frames follow a path.
        jumps: rows of frames that the camera cannot have reached.
    """

    later: NDArray[np.int64]
    length: Floats
    turn_deg: Floats
    extent: float
    step: float
    step_deg: float
    in_order: bool
    jumps: NDArray[np.int64]

    def steps(self, length: Floats, turn_deg: Floats) -> Floats:
        """How many steps a distance comes to, the larger of those moved and those turned."""
        return np.maximum(length / self.step, turn_deg / self.step_deg)


def motion_of(capture: Capture) -> Motion:
    """Measure the steps of a capture of two frames or more."""
    position, quaternion = capture.world_from_cam[:, :3, 3], quaternions(capture)
    names = np.array(capture.sequences)
    later = 1 + np.flatnonzero(names[1:] == names[:-1])
    length = np.linalg.norm(position[later] - position[later - 1], axis=1)
    turn_deg = rotation_error_deg(quaternion[later], quaternion[later - 1])
    extent = float(np.linalg.norm(sides_of(position))) or float(np.linalg.norm(np.ptp(position, axis=0)))
    in_order = len(later) > 0 and float(np.median(length)) <= _LONGEST_STEP * extent
    if in_order:
        step, step_deg = float(np.median(length)), float(np.median(turn_deg))
    else:
        step, step_deg = _to_nearest(position, quaternion)
    far = (length > _JUMP_STEPS * step) & (length > _JUMP_SHARE * extent)
    jumps = far | ((turn_deg > _JUMP_STEPS * step_deg) & (turn_deg > _JUMP_DEG))
    return Motion(
        later,
        length,
        turn_deg,
        extent,
        max(step, _MIN_STEP * extent, 1e-12),
        max(step_deg, _MIN_DEG),
        in_order,
        later[jumps] if in_order else later[:0],
    )


def sides_of(position: Floats) -> Floats:
    """Sides of the box that holds nine tenths of positions (N, 3) along each axis; not interpolated."""
    low = np.percentile(position, 5, axis=0, method="higher")
    return np.maximum(np.percentile(position, 95, axis=0, method="lower") - low, 0.0)


def quaternions(capture: Capture) -> Floats:
    """Rotations of a capture's cameras, canonical wxyz, (N, 4)."""
    return quaternion_from_matrix(capture.world_from_cam[:, :3, :3])


def pairwise_distances(
    position: Floats, quaternion: Floats, rows: NDArray[np.int64], others: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """How far each of some frames is from each of others: lengths and degrees, (R, O) each."""
    length, turn_deg = np.empty((2, len(rows), len(others)))
    at_once = max(1, _PAIRS_AT_ONCE // max(1, len(others)))
    for start in range(0, len(rows), at_once):
        block = slice(start, start + at_once)
        length[block] = cdist(position[rows[block]], position[others])
        turned = quaternion[rows[block]]
        turn_deg[block] = degrees_of_chords(cdist(turned, quaternion[others]), cdist(turned, -quaternion[others]))
    return length, turn_deg


def _to_nearest(position: Floats, quaternion: Floats) -> tuple[float, float]:
    """Medians of the distance to the nearest other frame, and of how far that is turned."""
    lengths, turns = [], []
    everything = np.arange(len(position))
    for row in everything[:: max(1, len(everything) // 1000)]:
        length, turn_deg = (
            each[0] for each in pairwise_distances(position, quaternion, everything[row : row + 1], everything)
        )
        length[row] = np.inf
        nearest = int(length.argmin())
        lengths.append(length[nearest])
        turns.append(turn_deg[nearest])
    return float(np.median(lengths)), float(np.median(turns))
