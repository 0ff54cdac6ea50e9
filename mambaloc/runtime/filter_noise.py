"""What a pose filter believes of poses and of motion: given, or learned from a video."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.runtime.rotations import multiply, quaternion_from_rotation_vector, rotation_vector_between

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Noise:
    """What a filter believes of poses and of motion: standard deviations along each axis.

    The defaults of motion are a hand's: what the true trajectories of 7-Scenes' training sequences do in half a second,
    which is much alike in all seven scenes (0.15 to 0.25 m/s², 13 to 25 deg/s²).

    Args:
        position_m: error of a measured position.
        rotation_deg: of a measured rotation.
        acceleration_m_s2: averaged over a second; it is white, so over a quarter of one it is twice as much.
        acceleration_deg_s2: the same of the rotation.

    Raises:
        InputError: for one that is not a positive number.
    """

    position_m: float = 0.2
    rotation_deg: float = 6.0
    acceleration_m_s2: float = 0.2
    acceleration_deg_s2: float = 15.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < np.inf:
                raise InputError(f"Noise({name}={value}): is a standard deviation; give a positive number")

    @classmethod
    def learned(cls, time_s: Array, position_m: Array, quaternion: Array) -> Noise:
        """What errors a video's poses seem to have where a hand moves the camera.

        A pose's distance from the line between those a quarter of a second before and after shows an error, less what
        motion adds. The far fifth of distances are outliers, and errors are twice what the others show, as much of each
        is common to all three (half or twice as much made little difference on frames held out, and on rendered ones).

        Args:
            time_s: (N,), in order; N is 3 or more.
            position_m: (N, 3), finite.
            quaternion: (N, 4), unit.
        """
        step_s = max(float(np.median(np.diff(time_s))), 1e-6)
        lag = int(np.clip(round(0.25 / step_s), 1, (len(time_s) - 1) // 2))
        first, middle, last = slice(None, -2 * lag), slice(lag, -lag), slice(2 * lag, None)
        before_s, after_s = time_s[middle] - time_s[first], time_s[last] - time_s[middle]
        whole_s = np.maximum(before_s + after_s, 1e-6)
        share = (before_s / whole_s)[:, None]
        line_m = position_m[first] * (1 - share) + position_m[last] * share
        turned_rad = share * rotation_vector_between(quaternion[first], quaternion[last])
        line = multiply(quaternion[first], quaternion_from_rotation_vector(turned_rad))
        off_m, off_deg = position_m[middle] - line_m, np.degrees(rotation_vector_between(line, quaternion[middle]))

        errors = 1 + np.median(share**2 + (1 - share) ** 2)  # of three poses, in that of one: variance
        motions = np.median(before_s**2 * after_s**2 / (3 * whole_s))  # of white acceleration, likewise
        found = []
        for off, acceleration in ((off_m, cls.acceleration_m_s2), (off_deg, cls.acceleration_deg_s2)):
            shown = (np.quantile(np.abs(off), 0.8) / 1.2816) ** 2  # four fifths of normal numbers lie within 1.28
            found.append(2 * np.sqrt(max(shown - motions * acceleration**2, shown / 4) / errors))
        # No such model is nearer than these, and poses off by more than 15 degrees are outliers wherever they are many.
        return cls(max(found[0], 0.02), float(np.clip(found[1], 1, 15)))
