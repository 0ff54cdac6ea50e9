"""How far off a pose may be, in one number, from its covariance."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

LEVEL = 0.9
"""Share of poses whose errors are to be within their radii."""


def covariance_radius(covariance: ArrayLike, level: float = LEVEL) -> float:
    """The radius of the ball that a normal error of this covariance stays in with a probability.

    The squared length of the error is taken for a multiple of a chi-squared variable with its mean and variance
    (Satterthwaite 1946), whose quantile is Wilson's and Hilferty's (1931). For three dimensions the radius is within
    3 % of the exact one.

    Args:
        covariance: (D, D), in the radius' unit squared.
        level: the probability.
    """
    matrix = np.asarray(covariance, np.float64)
    mean = float(np.trace(matrix))
    if not mean > 0:
        return mean  # nothing varies, or nothing is known
    freedom_9 = 9 * mean**2 / float((matrix**2).sum())
    z = NormalDist().inv_cdf(level)
    return float(np.sqrt(mean * (1 - 2 / freedom_9 + z * np.sqrt(2 / freedom_9)) ** 3))
