"""What would make poses and images agree where they do not: another convention, another order, a delay.

No pose file says for sure in which direction its poses transform, nor which way its cameras look, and where images and
poses are associated by their order or by two clocks they may belong to other frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.importing.capture import OPENCV_FROM_OPENGL, Capture
from mambaloc.importing.checks.epipolar import agrees
from mambaloc.importing.checks.matching import Matches
from mambaloc.runtime.rotations import matrix_from_quaternion, quaternion_from_matrix
from mambaloc.text import natural

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]


def _with_other_scalar(rolled: int) -> Callable[[Floats], Floats]:
    """What poses were, if the four numbers of their quaternions are taken in another order."""

    def meant(poses: Floats) -> Floats:
        quaternions = np.roll(quaternion_from_matrix(poses[:, :3, :3]), rolled, axis=1)
        others = poses.copy()
        others[:, :3, :3] = matrix_from_quaternion(quaternions)
        return others

    return meant


_FIRST, _LAST = _with_other_scalar(-1), _with_other_scalar(1)

AS_READ = "as they were read"
WORLD_TO_CAMERA = "world to camera"
CONVENTIONS: Mapping[str, Callable[[Floats], Floats]] = {
    AS_READ: lambda poses: poses,
    WORLD_TO_CAMERA: np.linalg.inv,
    "camera to world in OpenGL's axes": lambda poses: poses @ OPENCV_FROM_OPENGL,
    "world to camera in OpenGL's axes": lambda poses: np.linalg.inv(poses) @ OPENCV_FROM_OPENGL,
    "camera to world with the quaternions' scalar first": _FIRST,
    "camera to world with the quaternions' scalar last": _LAST,
    "world to camera with the quaternions' scalar first": lambda poses: np.linalg.inv(_FIRST(np.linalg.inv(poses))),
    "world to camera with the quaternions' scalar last": lambda poses: np.linalg.inv(_LAST(np.linalg.inv(poses))),
}
"""What makes ``world_from_cam`` in OpenCV's axes of poses that were meant otherwise."""

_MAX_SHIFT = 15  # frames
_CLEARLY = 0.05
_DEVIATIONS = 3.0


@dataclass(frozen=True)
class Order:
    """Another association of images with poses that clearly more matches agree with.

    Args:
        name: which.
        share: of the matches that agree with it.
        as_read: of the same matches, with the poses as they were read.
    """

    name: str
    share: float
    as_read: float


def by_convention(matches: Matches, world_from_cam: Floats) -> dict[str, float]:
    """The share of neighbours' matches that agree with the poses, if these were meant in each convention."""
    near = matches.of_pairs(np.arange(matches.neighbours))
    return {name: _share(agrees(near, meant(world_from_cam))) for name, meant in CONVENTIONS.items()}


def better_order(capture: Capture, matches: Matches) -> Order | None:
    """Find the association of images with poses that most matches agree with, where it is clearly another."""
    near = matches.of_pairs(np.arange(matches.neighbours))
    found: Order | None = None
    for name, pose_of in _orders(capture.sequences, capture.images).items():
        there = np.flatnonzero((pose_of[near.pairs] >= 0).all(axis=1))
        if 2 * len(there) < len(near.pairs) or len(there) < 2:
            continue
        judged = near.of_pairs(there)
        counts = judged.per_pair()
        ours, others = (
            judged.per_pair(agrees(judged, poses))
            for poses in (capture.world_from_cam, capture.world_from_cam[pose_of])
        )
        if _is_clear(others - ours, counts):
            share = float(others.sum() / counts.sum())
            if found is None or share > found.share:
                found = Order(name, share, float(ours.sum() / counts.sum()))
    return found


def _orders(sequences: Sequence[str], images: Sequence[Path]) -> dict[str, Indices]:
    """Which row's pose each image would have, (N,); -1 where none."""
    every, of = np.arange(len(images)), np.array(sequences)
    orders = {"the poses in reverse": np.empty_like(every)}
    by_name: dict[str, Callable[[Path], Any]] = {
        "the images sorted as text": lambda image: image.name,
        "the images sorted by the numbers in their names": natural,
    }
    orders |= {name: np.empty_like(every) for name in by_name}
    shifts = [shift for shift in range(-_MAX_SHIFT, _MAX_SHIFT + 1) if shift]
    orders |= {_shifted(shift): np.full_like(every, -1) for shift in shifts}
    for sequence in dict.fromkeys(sequences):
        rows = np.flatnonzero(of == sequence)
        orders["the poses in reverse"][rows] = rows[::-1]
        for name, key in by_name.items():
            orders[name][sorted(rows.tolist(), key=lambda row: key(images[row]))] = rows
        for shift in shifts:
            fits = (np.arange(len(rows)) + shift >= 0) & (np.arange(len(rows)) + shift < len(rows))
            orders[_shifted(shift)][rows[fits]] = rows[np.arange(len(rows))[fits] + shift]
    return {name: pose_of for name, pose_of in orders.items() if not np.array_equal(pose_of, every)}


def _shifted(shift: int) -> str:
    frames = "frame" if abs(shift) == 1 else "frames"
    return f"the poses of {abs(shift)} {frames} {'later' if shift > 0 else 'earlier'}"


def _is_clear(gained: Indices, counts: Indices) -> bool:
    """Whether a share grows by more than its own uncertainty, estimated from how pairs differ."""
    gain = gained.sum() / max(counts.sum(), 1)
    deviation = np.sqrt(((gained - gain * counts) ** 2).sum()) / max(counts.sum(), 1)
    return bool(gain > max(_CLEARLY, _DEVIATIONS * deviation))


def _share(agreeing: NDArray[np.bool_]) -> float:
    return float(agreeing.mean()) if len(agreeing) else 0.0
