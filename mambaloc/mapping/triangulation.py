"""Points from tracks: robust triangulation from many views whose poses are given.

With the poses fixed, bundle adjustment falls apart into one problem of three unknowns a point, so all points are solved
at once by Gauss-Newton steps on (T, 3, 3) normal equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

_DRAWS = 16  # pairs of views tried a track
_STEPS = 5
_DAMPING = 1e-6  # of the normal equations' trace
_MIN_ANGLE_DEG = 1.5
_MIN_SHARE = 0.25


@dataclass(frozen=True)
class Observations:
    """Where frames see tracks, one row an observation, those of a track together.

    Shape:
        ``frame`` (O,), ``track`` (O,) ascending, ``rays`` (O, 2) in the plane at depth 1, and ``near`` (O,): how far
        in that plane a point may be from its ray.
    """

    frame: Indices
    track: Indices
    rays: Floats
    near: Floats

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: NDArray[np.generic]) -> Observations:
        """Select some, by indices or a mask."""
        return Observations(self.frame[rows], self.track[rows], self.rays[rows], self.near[rows])

    def as_near_as(self, off: Floats) -> Observations:
        """The same, nearer where most are: five times the median of what agrees, as far as that is less."""
        agrees = off <= self.near
        share = 5 * float(np.median(off[agrees] / self.near[agrees])) if agrees.any() else 1.0
        return Observations(self.frame, self.track, self.rays, self.near * min(1.0, max(share, _MIN_SHARE)))

    def renumbered(self) -> Observations:
        """The same with tracks numbered from 0 without gaps."""
        return Observations(self.frame, np.unique(self.track, return_inverse=True)[1], self.rays, self.near)


def triangulate(
    cam_from_world: Floats, seen: Observations, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Triangulate tracks: of drawn pairs of views the one that most views agree with, refined on those that do.

    A point must be in front of its cameras, seen from two frames or more, and under 1.5 degrees or more.

    Args:
        cam_from_world: (N, 4, 4).
        seen: tracks numbered from 0 without gaps, each of two observations or more.
        rng: draws the pairs.

    Returns:
        Points (T, 3), whether each is one (T,), and which observations agree with theirs (O,).
    """
    if not len(seen):
        return np.empty((0, 3)), np.empty(0, bool), np.empty(0, bool)
    points = _best_of_pairs(cam_from_world, seen, rng)
    for _ in range(2):
        off = residuals(cam_from_world, seen, points)
        points = _refined(cam_from_world, seen, points, off <= seen.near)
        seen = seen.as_near_as(residuals(cam_from_world, seen, points))
    agrees = residuals(cam_from_world, seen, points) <= seen.near
    frames = _count(seen.track[agrees], len(points), seen.frame[agrees])
    is_point = (frames >= 2) & (_widest_angle_deg(cam_from_world, seen, points, agrees) >= _MIN_ANGLE_DEG)
    return points, is_point, agrees


def residuals(cam_from_world: Floats, seen: Observations, points: Floats) -> Floats:
    """How far points (T, 3) are from where they are seen, in the plane at depth 1, (O,); infinite behind a camera."""
    cam = np.einsum("oij,oj->oi", cam_from_world[seen.frame, :3, :3], points[seen.track])
    cam += cam_from_world[seen.frame, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(cam[:, :2] / cam[:, 2:] - seen.rays, axis=1)
    return np.where((cam[:, 2] > 0) & np.isfinite(off), off, np.inf)


def _best_of_pairs(cam_from_world: Floats, seen: Observations, rng: np.random.Generator) -> Floats:
    """Of drawn pairs of views of each track, the point of the pair with the least truncated squares of all views."""
    center, ray = _world_rays(cam_from_world, seen)
    start = np.flatnonzero(np.diff(seen.track, prepend=-1))
    length = np.diff(start, append=len(seen))
    best, lowest_cost = np.zeros((len(start), 3)), np.full(len(start), np.inf)
    for _ in range(_DRAWS):
        one = rng.integers(length)
        other = (one + 1 + rng.integers(length - 1)) % length
        points = _between(center[start + one], ray[start + one], center[start + other], ray[start + other])
        off = np.minimum(residuals(cam_from_world, seen, points) / seen.near, 1) ** 2
        cost = np.add.reduceat(off, start)
        is_better = cost < lowest_cost
        best[is_better], lowest_cost[is_better] = points[is_better], cost[is_better]
    return best


def _world_rays(cam_from_world: Floats, seen: Observations) -> tuple[Floats, Floats]:
    """Camera centres and unit directions in the world, (O, 3) each."""
    rotation, shift = cam_from_world[seen.frame, :3, :3], cam_from_world[seen.frame, :3, 3]
    direction = np.einsum("oji,oj->oi", rotation, np.hstack((seen.rays, np.ones((len(seen), 1)))))
    return -np.einsum("oji,oj->oi", rotation, shift), direction / np.linalg.norm(direction, axis=1, keepdims=True)


def _between(start_a: Floats, ray_a: Floats, start_b: Floats, ray_b: Floats) -> Floats:
    """The middle of the shortest line between two rays, (T, 3); anywhere where they are parallel."""
    baseline, cosine = start_b - start_a, (ray_a * ray_b).sum(axis=1)
    along_a, along_b = (baseline * ray_a).sum(axis=1), (baseline * ray_b).sum(axis=1)
    scale = 1 / np.maximum(1 - cosine**2, 1e-12)
    on_a = start_a + ((along_a - cosine * along_b) * scale)[:, None] * ray_a
    on_b = start_b + ((cosine * along_a - along_b) * scale)[:, None] * ray_b
    return (on_a + on_b) / 2


def _refined(cam_from_world: Floats, seen: Observations, points: Floats, counts: NDArray[np.bool_]) -> Floats:
    """Least squares of the views that count, with Cauchy's weights, by damped Gauss-Newton steps."""
    used, points = seen.select(counts), points.copy()
    rotation, shift = cam_from_world[used.frame, :3, :3], cam_from_world[used.frame, :3, 3]
    for _ in range(_STEPS):
        cam = np.einsum("oij,oj->oi", rotation, points[used.track]) + shift
        depth = np.maximum(cam[:, 2], 1e-9)[:, None]
        off = (cam[:, :2] / depth - used.rays) / used.near[:, None]
        slope = (rotation[:, :2] - (cam[:, :2] / depth)[..., None] * rotation[:, 2:]) / (depth * used.near[:, None])[
            ..., None
        ]
        weight = 1 / (1 + 4 * (off**2).sum(axis=1))  # half where a view is off by half of what is allowed
        normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        np.add.at(normal, used.track, np.einsum("o,oki,okj->oij", weight, slope, slope))
        np.add.at(right, used.track, np.einsum("o,oki,ok->oi", weight, slope, off))
        trace = np.trace(normal, axis1=1, axis2=2)
        normal += (np.where(trace > 0, _DAMPING * trace, 1))[:, None, None] * np.eye(3)
        points -= np.linalg.solve(normal, right[..., None])[..., 0]
    return points


def _count(track: Indices, tracks: int, frame: Indices) -> Indices:
    """How many different frames each track has, (tracks,)."""
    different = np.unique(np.stack((track, frame)), axis=1)
    return np.bincount(different[0], minlength=tracks)


def _widest_angle_deg(cam_from_world: Floats, seen: Observations, points: Floats, counts: NDArray[np.bool_]) -> Floats:
    """The widest angle under which the views that count see each point, (T,): from the farthest of any, the farthest.

    That is between half of the widest and the widest itself.
    """
    used = seen.select(counts)
    center = _world_rays(cam_from_world, used)[0]
    towards = center - points[used.track]
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    tracks, start = np.unique(used.track, return_index=True)
    pivot, min_cosine = np.zeros((len(points), 3)), np.ones(len(points))
    pivot[tracks] = towards[start]
    for _ in range(2):
        cosine = (towards * pivot[used.track]).sum(axis=1)
        order = np.lexsort((cosine, used.track))
        first = order[np.searchsorted(used.track[order], tracks)]
        min_cosine[tracks], pivot[tracks] = cosine[first], towards[first]
    return np.degrees(np.arccos(np.clip(min_cosine, -1, 1)))
