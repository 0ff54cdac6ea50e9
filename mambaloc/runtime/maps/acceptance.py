"""How probable it is that a pose found in a map is right, estimated from its distinctive matches.

A search around a wrong pose finds matches, too: one of the few points near a keypoint is the most similar, and the pose
follows those that agree by chance. Hardly any of these is distinctive: the most similar of all points in view.
All matches of a blurred image may be right and yet fix its pose to decimetres only: precision has its own bound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RULE = 3
"""Version of what follows."""
MIN_PROBABILITY = 0.95
"""The least probability of an accepted pose: of such poses of held-out training frames at most 0.5 % were wrong."""
MAX_DEVIATION = 0.12
"""The largest :attr:`Evidence.deviation` of an accepted pose: 8 cm in a room where key frames spread over 0.66 m."""
CALIBRATION = {"frames": 224, "pictures": 3222, "accepted": 0.677, "accepted_and_wrong": 0.0009}
"""How that was measured: frames held out of training, of a real room and a rendered one, each in two maps; disturbed
images that gave a pose; the share that is accepted, with 20 inliers, by coefficients that were fitted to
other sequences; and of these the wrong ones' (95 %: 0.03 to 0.33 %)."""

_CELLS = 4  # a side of the grid
_CONSTANT, _PER_CELLS, _PER_DEVIATION, _PER_TURN = -4.9, 3.48, -0.34, -1.01
_MIN_DEVIATION, _MIN_TURN_DEG = 1e-3, 0.1
_FOCAL_OFF, _FOCAL_DEVIATIONS = 0.03, 3.0


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose, without units of length.

    Args:
        cells: how many cells of a grid of 4 x 4 over the image have a distinctive match that agrees with the pose.
        deviation: of the position, one standard deviation in the worst direction, over the spread of the key frames:
            as all matches fix it or as distinctive ones alone do, whichever is larger.
        turn_deg: from RANSAC's pose to the refined one.
    """

    cells: int
    deviation: float
    turn_deg: float

    @property
    def probability(self) -> float:
        """That the pose is right, which means within 0.2 m and 5 degrees in rooms: a logistic regression."""
        if not math.isfinite(self.deviation):
            return 0.0
        cells, deviation, turn = self.logarithms()
        return 1 / (1 + math.exp(-(_CONSTANT + _PER_CELLS * cells + _PER_DEVIATION * deviation + _PER_TURN * turn)))

    @property
    def is_enough(self) -> bool:
        """Whether the pose is accepted, if it has enough inliers and the focal length fits."""
        return self.probability >= MIN_PROBABILITY and self.deviation <= MAX_DEVIATION

    def logarithms(self) -> tuple[float, float, float]:
        """What the regression is linear in."""
        return (
            math.log(self.cells + 0.5),
            math.log(max(self.deviation, _MIN_DEVIATION)),
            math.log(self.turn_deg + _MIN_TURN_DEG),
        )


def occupied_cells(pixels: NDArray[np.float64], size: tuple[int, int]) -> int:
    """How many cells of a grid over an image of ``size`` (width, height) hold one of the pixels (N, 2) or more."""
    return len(np.unique(np.floor((pixels + 0.5) * (_CELLS / np.array(size))), axis=0))


def is_another_focal_length(scale: float, deviation: float) -> bool:
    """Whether matches contradict the given focal length: by more than 3 % and three standard deviations."""
    return abs(math.log(scale)) > max(_FOCAL_OFF, _FOCAL_DEVIATIONS * deviation)
