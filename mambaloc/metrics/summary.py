"""Errors of a split in a few numbers: medians, means and recalls. Needs no torch."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

RECALL_THRESHOLDS: dict[str, tuple[float, float]] = {
    "recall_5cm_5deg": (0.05, 5.0),
    "recall_10cm_5deg": (0.10, 5.0),
    "recall_25cm_2deg": (0.25, 2.0),
    "recall_50cm_5deg": (0.50, 5.0),
}
"""Shares of frames within both a position error in metres and a rotation error in degrees."""


def summarize_errors(position_m: ArrayLike, rotation_deg: ArrayLike) -> dict[str, float]:
    """Reduce errors to medians, means, the worst position and recalls; the plain names are the medians.

    The median of an even number of frames is the mean of the middle two. An infinite error, of a frame without a pose,
    counts in medians and recalls, and is left out of means, which are infinite where no other is left. NaN stays NaN.

    Args:
        position_m: one a frame, (N,).
        rotation_deg: of the same frames.
    """
    position_m, rotation_deg = np.asarray(position_m, np.float64), np.asarray(rotation_deg, np.float64)
    has_pose = ~np.isinf(position_m)
    summary = {
        "position_error_m": float(np.median(position_m)),
        "rotation_error_deg": float(np.median(rotation_deg)),
        "position_error_mean_m": float(position_m[has_pose].mean()) if has_pose.any() else math.inf,
        "rotation_error_mean_deg": float(rotation_deg[has_pose].mean()) if has_pose.any() else math.inf,
        "position_error_worst_m": float(position_m.max()),
    }
    for name, (within_m, within_deg) in RECALL_THRESHOLDS.items():
        summary[name] = float(((position_m <= within_m) & (rotation_deg <= within_deg)).mean())
    return summary
