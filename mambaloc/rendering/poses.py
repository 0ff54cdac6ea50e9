"""Rotations as this package needs them: NumPy arrays, scalar-first unit quaternions with ``w >= 0``."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mambaloc.rendering.quads import Vectors


def matrix_from_quaternion(quaternion: ArrayLike) -> Vectors:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), wxyz, of any norm but 0."""
    q = np.asarray(quaternion, dtype=float)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def quaternion_from_matrix(rotation: ArrayLike) -> Vectors:
    """The unit quaternion (4,), wxyz with ``w >= 0``, of one rotation matrix (3, 3)."""
    r = np.asarray(rotation, dtype=float)
    # The eigenvector form of Bar-Itzhack (2000): no case distinction, and the best fit of a noisy matrix.
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]
    return q if q[0] >= 0 else -q


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
    world_from_cam = np.tile(np.eye(4), (len(a), 1, 1))
    world_from_cam[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    world_from_cam[:, :3, 3] = position_m
    return world_from_cam
