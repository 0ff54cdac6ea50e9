"""Where a hand would carry a camera: smooth, seeded paths through a box."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mambaloc.rendering.quads import Vectors
from mambaloc.runtime.rotations import rigid_transforms

_KNOT_DEG = 30.0  # how far the view turns between two way points


def smooth_trajectory(
    n: int, seed: int, inside_m: ArrayLike, *, start_deg: float | None = None, step_deg: float = 1.0
) -> Vectors:
    """A camera that wanders through a box and turns, looking across the room.

    The path is a cubic B-spline through seeded way points, which never leaves their convex hull. The camera
    keeps to the side it turns its back on, so that it sees most of the room.

    Args:
        n: number of poses.
        seed: another seed is another path.
        inside_m: (2, 3) lower and upper corner of the box that the camera stays in; ``z`` is up.
        start_deg: azimuth of the first view, from ``x`` towards ``y``; random by default.
        step_deg: mean turn from one pose to the next; the way gone grows with it.

    Returns:
        ``world_from_cam`` (n, 4, 4), metres.
    """
    rng = np.random.default_rng(seed)
    start = rng.uniform(0, 360) if start_deg is None else start_deg
    turn = rng.choice([-1.0, 1.0])
    knots = step_deg / _KNOT_DEG * np.arange(n)
    sway, gaze = _spline_noise(rng, knots, 3), _spline_noise(rng, knots, 3)
    tremor = _spline_noise(rng, 12 * knots, 6)

    azimuth_deg = start + turn * step_deg * np.arange(n) + 14 * gaze[:, 0] + 0.25 * tremor[:, 0]
    pitch_deg = -6 + 12 * gaze[:, 1] + 0.25 * tremor[:, 1]
    roll_deg = 5 * gaze[:, 2] + 0.15 * tremor[:, 2]
    azimuth, pitch, roll = np.radians(azimuth_deg), np.radians(pitch_deg), np.radians(roll_deg)

    ring = np.stack([-np.cos(azimuth), -np.sin(azimuth), np.zeros(n)], axis=1)
    # Each term is bounded, and their bounds sum to one: the camera stays inside.
    unit = ring * [0.55, 0.55, 0] + sway * [0.445, 0.445, 0.98] + tremor[:, 3:] * [0.005, 0.005, 0.02]
    lower, upper = np.asarray(inside_m, dtype=float)
    return looking((lower + upper) / 2 + unit * (upper - lower) / 2, azimuth, pitch, roll)


def looking(position_m: ArrayLike, azimuth_rad: ArrayLike, pitch_rad: ArrayLike, roll_rad: ArrayLike) -> Vectors:
    """Poses ``world_from_cam`` (N, 4, 4) in a world whose ``z`` is up.

    Args:
        position_m: (N, 3) camera centres, metres.
        azimuth_rad: (N,) direction of view about ``z``, from ``x`` towards ``y``.
        pitch_rad: (N,) upwards from the horizon.
        roll_rad: (N,) clockwise about the direction of view.
    """
    a, p, r = (np.asarray(angle, dtype=float) for angle in (azimuth_rad, pitch_rad, roll_rad))
    forward = np.stack([np.cos(p) * np.cos(a), np.cos(p) * np.sin(a), np.sin(p)], axis=-1)
    level_right = np.stack([np.sin(a), -np.cos(a), np.zeros_like(a)], axis=-1)
    level_down = np.cross(forward, level_right)
    cos_r, sin_r = np.cos(r)[:, None], np.sin(r)[:, None]
    right = cos_r * level_right + sin_r * level_down
    return rigid_transforms(np.stack([right, np.cross(forward, right), forward], axis=-1), position_m)


def _spline_noise(rng: np.random.Generator, knots: Vectors, channels: int) -> Vectors:
    """A uniform cubic B-spline (len(knots), channels) with control points from -1..1, one per unit of ``knots``."""
    control = rng.uniform(-1, 1, (int(knots[-1]) + 4, channels))
    first = knots.astype(int)
    t = (knots - first)[:, None]
    weights = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    return sum(weight * control[first + k] for k, weight in enumerate(weights)) / 6
