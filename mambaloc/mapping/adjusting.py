"""Bundle adjustment: poses, points and lenses that agree with the images, held near what was given.

Given poses drift, so that no points fit all images that were posed with them. Adjusted poses do. How far each moved
is the drift, and :mod:`mambaloc.runtime.maps.drift` carries answers back to the frame of the given poses. From images
alone small baselines would bend the map, so the given poses and the given cameras are priors, and so are depths where
they were measured.

Levenberg-Marquardt on the reduced camera system (Triggs et al. 2000, section 6.1): points are eliminated, and one dense
system of six unknowns a frame and two a lens is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from mambaloc.mapping.triangulation import Observations
from mambaloc.runtime.maps.lens import Lens
from mambaloc.runtime.maps.viewpoints import spread_m

Floats = NDArray[np.floating[Any]]

_STEPS = 12
_CONVERGED = 1e-3  # of the cost
_DAMPING, _MAX_DAMPING = 1e-4, 1e4
_FOCAL, _RADIAL = 0.02, 0.05  # one standard deviation of the prior
_FIXED = 1e-9
_MIN_DEPTH = 1e-3  # of the cameras' spread
_DEPTH = 0.02  # of a measured depth, one standard deviation


@dataclass(frozen=True)
class Bundle:
    """What is adjusted.

    Shape:
        ``world_from_cam`` (N, 4, 4); ``points_m`` (T, 3); ``lenses`` C, one a camera.
    """

    world_from_cam: Floats
    points_m: Floats
    lenses: tuple[Lens, ...] = (Lens(),)

    def moved(self, frames: Floats, points_m: Floats, lenses: Floats) -> Bundle:
        """Shift and turn frames about the world's axes (N, 6), shift points (T, 3), and change lenses (C, 2)."""
        poses = self.world_from_cam.copy()
        poses[:, :3, 3] += frames[:, :3]
        poses[:, :3, :3] = np.stack([cv2.Rodrigues(turn)[0] for turn in frames[:, 3:]]) @ poses[:, :3, :3]
        moved = [Lens(*(lens.numbers + step)) for lens, step in zip(self.lenses, lenses, strict=True)]
        return Bundle(poses, self.points_m + points_m, tuple(moved))


def adjust(
    start: Bundle,
    given: Floats,
    drift: tuple[float, float],
    seen: Observations,
    sigma: float,
    camera: NDArray[np.int64] | None = None,
    depth_m: Floats | None = None,
    is_fixed: NDArray[np.bool_] | None = None,
) -> Bundle:
    """Minimise the reprojection errors over poses, points and lenses, with Cauchy's robust loss.

    Args:
        start: the points are the tracks of ``seen``.
        given: ``world_from_cam`` (N, 4, 4).
        drift: how far a frame is from where it was given, in metres and radians along an axis, one standard deviation.
        seen: rays as the claimed intrinsics have them.
        sigma: an observation that is off by so much, in the plane at depth 1, has half the weight.
        camera: which lens of ``start`` each frame was taken with, (N,). Where that is not given, it is the first, and
            no lens is adjusted.
        depth_m: measured along the optical axis, of each observation (O,); NaN where it was not.
        is_fixed: points that stay where they are, (T,); none unless given.
    """
    depth_m = np.full(len(seen), np.nan) if depth_m is None else depth_m
    problem = _Problem(start, given, drift, seen, sigma, camera, depth_m)
    if is_fixed is not None:
        problem.is_fixed = is_fixed[seen.track]
    now, cost, damping = start, problem.cost(start), _DAMPING
    for _ in range(_STEPS):
        equations = problem.linearized(now)
        new_cost = np.inf
        while new_cost >= cost and damping < _MAX_DAMPING:
            new = now.moved(*equations.solve(damping))
            new_cost, damping = problem.cost(new), damping * 10
        if new_cost >= cost:
            break
        has_converged = cost - new_cost <= _CONVERGED * cost
        now, cost, damping = new, new_cost, damping / 100
        if has_converged:
            break
    return now


def moves(given: Floats, adjusted: Floats) -> Floats:
    """Shifts, and turns about the world's axes, from given to adjusted ``world_from_cam`` (N, 4, 4); (N, 6)."""
    turns = adjusted[:, :3, :3] @ given[:, :3, :3].transpose(0, 2, 1)
    return np.hstack((adjusted[:, :3, 3] - given[:, :3, 3], [cv2.Rodrigues(turn)[0][:, 0] for turn in turns]))


class _Problem:
    """Observations and priors, both in units of their standard deviations."""

    def __init__(
        self,
        start: Bundle,
        given: Floats,
        drift: tuple[float, float],
        seen: Observations,
        sigma: float,
        camera: NDArray[np.int64] | None,
        depth_m: Floats,
    ) -> None:
        self.given, self.seen, self.sigma = given, seen, sigma
        self.is_fixed = np.zeros(len(seen), bool)
        self.is_measured = np.isfinite(depth_m)
        self.depth_m = np.where(self.is_measured, depth_m, np.inf)[:, None]  # infinite, so that it weighs nothing
        self.min_depth = _MIN_DEPTH * spread_m(given)
        self.of_lens = np.zeros(len(seen), np.int64) if camera is None else camera[seen.frame]
        pose, lens = np.repeat(drift, 3), np.array((_FOCAL, _RADIAL)) * (_FIXED if camera is None else 1)
        self.prior = np.concatenate((np.tile(pose, len(given)), np.tile(lens, len(start.lenses)))) ** -2.0
        self.first = np.searchsorted(seen.track, np.arange(seen.track[-1] + 1))

    def cost(self, at: Bundle) -> float:
        off = self._project(at)[0]
        return float(np.log1p((off**2).sum(axis=1)).sum() + (self.moves(at) ** 2 * self.prior).sum())

    def moves(self, at: Bundle) -> Floats:
        """How far frames and lenses are from where they were given, (6 N + 2 C,)."""
        lenses = [lens.numbers - Lens().numbers for lens in at.lenses]
        return np.concatenate((moves(self.given, at.world_from_cam).ravel(), *lenses))

    def _project(self, at: Bundle) -> tuple[Floats, Floats, Floats, Floats]:
        """Residuals (O, 3), from cameras to points in the world (O, 3), ideal rays (O, 2), and depths (O, 1).

        A residual is two of the ray and one of the depth.
        """
        towards = at.points_m[self.seen.track] - at.world_from_cam[self.seen.frame, :3, 3]
        cam = np.einsum("oji,oj->oi", at.world_from_cam[self.seen.frame, :3, :3], towards)
        depth = np.maximum(cam[:, 2:], self.min_depth)
        ideal = cam[:, :2] / depth
        claimed = np.empty_like(ideal)
        for number, lens in enumerate(at.lenses):
            claimed[self.of_lens == number] = lens.distort(ideal[self.of_lens == number])
        of_ray = (claimed - self.seen.rays) / self.sigma
        of_depth = np.where(self.is_measured[:, None], (depth / self.depth_m - 1) / _DEPTH, 0.0)
        return np.hstack((of_ray, of_depth)), towards, ideal, depth

    def linearized(self, at: Bundle) -> _Equations:
        """Normal equations at a bundle."""
        off, towards, ideal, depth = self._project(at)
        weight = 1 / np.sqrt(1 + (off**2).sum(axis=1))[:, None, None]
        inverse = at.world_from_cam[self.seen.frame, :3, :3].transpose(0, 2, 1)
        by_ray, by_lens = np.empty((len(ideal), 2, 2)), np.zeros((len(ideal), 3, 2 * len(at.lenses)))
        for number, lens in enumerate(at.lenses):
            rows, own = np.flatnonzero(self.of_lens == number), slice(2 * number, 2 * number + 2)
            by_ray[rows], by_lens[rows, :2, own] = lens.slopes(ideal[rows])
        by_lens /= self.sigma
        of_ray = by_ray @ (inverse[:, :2] - ideal[..., None] * inverse[:, 2:]) / depth[..., None] / self.sigma
        by_point = np.concatenate((of_ray, inverse[:, 2:] / (_DEPTH * self.depth_m[..., None])), axis=1)
        # A turn by θ about the world's axes moves a point, as the camera sees it, by -θ x towards.
        by_pose = np.concatenate((-by_point, by_point @ _cross(towards)), axis=-1)
        by_pose, by_lens, by_point = (weight * each for each in (by_pose, by_lens, by_point))
        by_point[self.is_fixed] = 0
        return _Equations(self, by_pose, by_lens, by_point, weight * off[..., None], self.moves(at))


class _Equations:
    """Normal equations in blocks: ``normal`` and ``right`` of frames and lenses, the rest of points."""

    def __init__(
        self, problem: _Problem, by_pose: Floats, by_lens: Floats, by_point: Floats, off: Floats, moves: Floats
    ) -> None:
        self.frame, self.track, self.first = problem.seen.frame, problem.seen.track, problem.first
        self.frames = len(problem.given)
        self.normal = np.diag(problem.prior)
        self.right = problem.prior * moves
        pose, lens = np.arange(6 * self.frames).reshape(-1, 6), 6 * self.frames + np.arange(by_lens.shape[-1])
        rows, columns = pose[self.frame][..., None], pose[self.frame][:, None]
        np.add.at(self.normal, (rows, columns), _t(by_pose) @ by_pose)
        np.add.at(self.normal, (rows, lens[None, None]), _t(by_pose) @ by_lens)
        np.add.at(self.right, pose[self.frame], (_t(by_pose) @ off)[..., 0])
        self.normal[lens[0] :, : lens[0]] = self.normal[: lens[0], lens[0] :].T
        self.normal[np.ix_(lens, lens)] += (_t(by_lens) @ by_lens).sum(axis=0)
        self.right[lens] += (_t(by_lens) @ off).sum(axis=0)[:, 0]
        self.pose_point = _t(by_pose) @ by_point
        self.lens_point = np.add.reduceat(_t(by_lens) @ by_point, self.first)
        self.point_normal = np.add.reduceat(_t(by_point) @ by_point, self.first)
        self.point_right = np.add.reduceat(_t(by_point) @ off, self.first)

    def solve(self, damping: float) -> tuple[Floats, Floats, Floats]:
        """Steps of frames (N, 6), points (T, 3) and lenses (C, 2)."""
        trace = np.trace(self.point_normal, axis1=1, axis2=2)
        inverse = np.linalg.inv(self.point_normal + (damping * trace + 1e-9)[:, None, None] * np.eye(3))
        root = np.linalg.cholesky(inverse)
        half, end = _t(root), 6 * self.frames
        # Points in axes in which their damped normal matrix is the identity.
        blocks = half[self.track] @ _t(self.pose_point), self.frame, np.append(self.first, len(self.track))
        poses = bsr_array(blocks, shape=(3 * len(root), end))
        lens = (half @ _t(self.lens_point)).reshape(-1, self.lens_point.shape[1])
        right = (half @ self.point_right).ravel()
        normal = self.normal + damping * np.diag(np.diag(self.normal))
        normal[:end, :end] -= (poses.T @ poses).toarray()
        normal[:end, end:] -= poses.T @ lens
        normal[end:, :end] = normal[:end, end:].T
        normal[end:, end:] -= lens.T @ lens
        step = -np.linalg.solve(normal, self.right - np.concatenate((poses.T @ right, lens.T @ right)))
        points = -root @ (right + poses @ step[:end] + lens @ step[end:]).reshape(-1, 3, 1)
        return step[:end].reshape(-1, 6), points[..., 0], step[end:].reshape(-1, 2)


def _t(matrices: Floats) -> Floats:
    return matrices.swapaxes(-1, -2)


def _cross(vectors: Floats) -> Floats:
    """Matrices (O, 3, 3) that take the cross product with vectors from the left."""
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    return matrices - _t(matrices)
