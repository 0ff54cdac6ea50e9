"""Bundle adjustment: poses and points together, with the given poses and measured depths as priors.

The points are eliminated (Schur's complement), so that each step solves for the cameras alone: Triggs et al. 2000,
"Bundle adjustment: a modern synthesis".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.mapping.triangulation import Observations

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

_STEPS = 30
_CONVERGED = 1e-4  # of the cost
_INDEPENDENT = 20.0  # observations that a frame's count as: one lens and one shutter displace them together
_DEPTH_SHARE = 0.02  # deviation of a depth, of itself


@dataclass(frozen=True)
class Prior:
    """How sure the given poses are: standard deviations of each frame's turn and of its camera's centre."""

    turn_rad: float
    move: float


def adjust(
    cam_from_world: Floats,
    seen: Observations,
    points: Floats,
    prior: Prior,
    depth: Floats | None = None,
    given: Floats | None = None,
    fixed: NDArray[np.bool_] | None = None,
) -> tuple[Floats, Floats]:
    """Adjust poses and points to what the frames see, by Levenberg-Marquardt with Cauchy's weights.

    Args:
        cam_from_world: of each frame, (N, 4, 4).
        seen: points 0 to T - 1, each of two observations or more, those of a point together.
        points: (T, 3), in front of the cameras that see them.
        prior: how sure the given poses are.
        depth: of each observation along the optical axis, NaN where it was not measured, (O,).
        given: the prior's poses, (N, 4, 4); ``cam_from_world`` unless given.
        fixed: points that stay where they are, (T,); none unless given.

    Returns:
        Poses (N, 4, 4) and points (T, 3).
    """
    given = cam_from_world if given is None else given
    fixed = np.zeros(len(points), bool) if fixed is None else fixed
    problem = _Problem(given, seen, prior, np.full(len(seen), np.nan) if depth is None else depth, fixed)
    poses, damping = cam_from_world.astype(np.float64), 1e-4
    cost = problem.cost(poses, points)
    for _ in range(_STEPS):
        equations = problem.linearized(poses, points)
        for _ in range(8):
            move, shift = equations.solved(damping)
            moved, shifted = _moved(poses, move), points + shift
            new = problem.cost(moved, shifted)
            if new <= cost:
                break
            damping *= 10
        else:
            return poses, points
        has_converged = cost - new <= _CONVERGED * cost
        poses, points, cost, damping = moved, shifted, new, max(damping / 10, 1e-9)
        if has_converged:
            break
    return poses, points


class _Problem:
    """Residuals and their slopes; an observation's are two of its ray and one of its depth, in deviations of each."""

    def __init__(
        self, given: Floats, seen: Observations, prior: Prior, depth: Floats, fixed: NDArray[np.bool_]
    ) -> None:
        self.given, self.seen, self.depth, self.fixed = given, seen, depth, fixed
        views = np.maximum(np.bincount(seen.frame, minlength=len(given)), _INDEPENDENT)
        self.prior_weight = np.repeat((views / _INDEPENDENT)[:, None], 6, axis=1)
        self.prior_weight[:, :3] /= prior.turn_rad**2
        self.prior_weight[:, 3:] /= prior.move**2
        self.centres = _centres(given)
        self.has_depth = np.isfinite(depth)
        self.layout = _Layout(seen.frame, seen.track, len(given))

    def cost(self, poses: Floats, points: Floats) -> float:
        """Cauchy's cost of all observations, and the prior's."""
        off = self._residuals(self._in_cameras(poses, points))
        apart = self._apart(poses)
        return float(np.log1p((off[:, :2] ** 2).sum(axis=1)).sum() + np.log1p(off[:, 2] ** 2).sum() +
                     (self.prior_weight * apart**2).sum())  # fmt: skip

    def linearized(self, poses: Floats, points: Floats) -> _NormalEquations:
        """Normal equations of turns and moves of the cameras in their own axes, and of the points."""
        seen, cam = self.seen, self._in_cameras(poses, points)
        off = self._residuals(cam)
        weight = 1 / (1 + np.stack(((off[:, :2] ** 2).sum(axis=1),) * 2 + (off[:, 2] ** 2,), axis=1))
        scale, z = 2 / seen.near, np.maximum(cam[:, 2], 1e-9)
        slope = np.zeros((len(seen), 3, 3))  # of the residuals by the point in the camera
        slope[:, 0, 0] = slope[:, 1, 1] = scale / z
        slope[:, :2, 2] = -(scale / z)[:, None] * (cam[:, :2] / z[:, None])
        slope[self.has_depth, 2, 2] = 1 / (_DEPTH_SHARE * self.depth[self.has_depth])
        by_camera = np.concatenate((-slope @ _cross(cam), slope), axis=2)
        by_point = slope @ poses[seen.frame, :3, :3]
        weighted = weight[:, :, None] * by_camera
        camera = self.layout.by_frame(np.einsum("oki,okj->oij", weighted, by_camera))
        camera_right = -self.layout.by_frame(np.einsum("oki,ok->oi", weighted, off))
        # The prior's residuals: the turn since given, in the camera's axes, and the centre's move, in the world's.
        apart, to_centre = self._apart(poses), -poses[:, :3, :3].swapaxes(1, 2)
        diagonal = np.zeros((len(poses), 6, 6))
        diagonal[:, range(3), range(3)] = self.prior_weight[:, :3]
        diagonal[:, 3:, 3:] = np.einsum("nki,nk,nkj->nij", to_centre, self.prior_weight[:, 3:], to_centre)
        pull = self.prior_weight * apart
        pull[:, 3:] = np.einsum("nki,nk->ni", to_centre, pull[:, 3:])
        point = self.layout.by_track(np.einsum("oki,ok,okj->oij", by_point, weight, by_point))
        point_right = -self.layout.by_track(np.einsum("oki,ok,ok->oi", by_point, weight, off))
        mixed = np.where(self.fixed[seen.track, None, None], 0, np.einsum("oki,okj->oij", weighted, by_point))
        point_right[self.fixed] = 0
        return _NormalEquations(camera + diagonal, camera_right - pull, point, point_right, mixed, self.layout)

    def _in_cameras(self, poses: Floats, points: Floats) -> Floats:
        seen = self.seen
        return np.einsum("oij,oj->oi", poses[seen.frame, :3, :3], points[seen.track]) + poses[seen.frame, :3, 3]

    def _residuals(self, cam: Floats) -> Floats:
        ray = cam[:, :2] / np.maximum(cam[:, 2:], 1e-9)
        depth = np.where(self.has_depth, (cam[:, 2] / self.depth - 1) / _DEPTH_SHARE, 0.0)
        return np.column_stack(((ray - self.seen.rays) * (2 / self.seen.near)[:, None], depth))

    def _apart(self, poses: Floats) -> Floats:
        """How far each pose is from that given: its turn as a rotation vector, and the move of its centre, (N, 6)."""
        turns = poses[:, :3, :3] @ self.given[:, :3, :3].swapaxes(1, 2)
        return np.column_stack(([cv2.Rodrigues(turn)[0][:, 0] for turn in turns], _centres(poses) - self.centres))


class _Layout:
    """Where each observation, and each two of a point, add to: sums of runs in a sorted order."""

    def __init__(self, frame: Indices, track: Indices, frames: int) -> None:
        self.frame, self.track, self.frames = frame, track, frames
        self.frame_order = np.argsort(frame, kind="stable")
        self.seen_frames, self.frame_start = np.unique(frame[self.frame_order], return_index=True)
        self.track_start = np.flatnonzero(np.diff(track, prepend=-1))
        length = np.diff(self.track_start, append=len(track))
        # Every two observations of a point, in both orders and with themselves.
        one = np.repeat(np.arange(len(track)), length[track])
        place = np.arange(len(one)) - np.repeat(np.cumsum(length[track]) - length[track], length[track])
        other = np.repeat(self.track_start[track], length[track]) + place
        key = frame[one] * frames + frame[other]
        order = np.argsort(key, kind="stable")
        self.one, self.other = one[order], other[order]
        self.keys, self.key_start = np.unique(key[order], return_index=True)

    def by_frame(self, values: Floats) -> Floats:
        total = np.zeros((self.frames, *values.shape[1:]))
        total[self.seen_frames] = np.add.reduceat(values[self.frame_order], self.frame_start)
        return total

    def by_track(self, values: Floats) -> Floats:
        return np.add.reduceat(values, self.track_start)


@dataclass(frozen=True)
class _NormalEquations:
    """Blocks of cameras (N, 6, 6) and points (T, 3, 3), their right sides, and what mixes them (O, 6, 3)."""

    camera: Floats
    camera_right: Floats
    point: Floats
    point_right: Floats
    mixed: Floats
    layout: _Layout

    def solved(self, damping: float) -> tuple[Floats, Floats]:
        """Steps of the cameras (N, 6) and of the points (T, 3)."""
        layout, count = self.layout, len(self.camera)
        inverse = np.linalg.inv(_damped(self.point, damping))
        carried = self.mixed @ inverse[layout.track]
        blocks = carried[layout.one] @ self.mixed[layout.other].swapaxes(1, 2)
        reduced = np.zeros((count * count, 6, 6))
        reduced[layout.keys] = -np.add.reduceat(blocks, layout.key_start)
        reduced[:: count + 1] += _damped(self.camera, damping)
        right = self.camera_right - layout.by_frame(np.einsum("oij,oj->oi", carried, self.point_right[layout.track]))
        matrix = reduced.reshape(count, count, 6, 6).swapaxes(1, 2).reshape(6 * count, 6 * count)
        move = np.linalg.solve(matrix, right.ravel()).reshape(count, 6)
        left = self.point_right - layout.by_track(np.einsum("oij,oi->oj", self.mixed, move[layout.frame]))
        return move, np.einsum("tij,tj->ti", inverse, left)


def _damped(blocks: Floats, damping: float) -> Floats:
    size = blocks.shape[-1]
    diagonal = np.einsum("nii->ni", blocks)
    return blocks + (damping * diagonal + 1e-12)[:, :, None] * np.eye(size)


def _moved(poses: Floats, move: Floats) -> Floats:
    """Turn and move cameras in their own axes: ``cam' = exp(turn) cam + move``."""
    turns = np.array([cv2.Rodrigues(turn)[0] for turn in move[:, :3]])
    moved = poses.copy()
    moved[:, :3] = turns @ poses[:, :3]
    moved[:, :3, 3] += move[:, 3:]
    return moved


def _centres(cam_from_world: Floats) -> Floats:
    return -np.einsum("nji,nj->ni", cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])


def _cross(vectors: Floats) -> Floats:
    """Matrices whose product with another vector is the cross product, (..., 3, 3)."""
    return np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)
