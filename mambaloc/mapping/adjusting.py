"""Bundle adjustment: poses, points and a lens that agree with the pictures, held near what was given.

Given poses drift, so that no points fit all pictures that were posed with them. Adjusted poses do. How far each moved
is the drift, and :mod:`mambaloc.runtime.maps.drift` carries answers back to the frame of the given poses. From pictures
alone small baselines would bend the map, so the given poses and the given camera are priors, and so are depths where
they were measured.

Levenberg-Marquardt on the reduced camera system (Triggs et al. 2000, section 6.1): points are eliminated, and one dense
system of six unknowns a camera and two of the lens is left.
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
_DAMPING, _MOST_DAMPING = 1e-4, 1e4
_FOCAL, _RADIAL = 0.02, 0.05  # one standard deviation of the prior
_FIXED = 1e-9
_LEAST_DEPTH = 1e-3  # of the cameras' spread
_DEPTH = 0.02  # of a measured depth, one standard deviation


@dataclass(frozen=True)
class Bundle:
    """What is adjusted.

    Shape:
        ``world_from_cam`` (N, 4, 4); ``points_m`` (T, 3).
    """

    world_from_cam: Floats
    points_m: Floats
    lens: Lens

    def moved(self, cameras: Floats, points_m: Floats, lens: Floats) -> Bundle:
        """Shift and turn cameras about the world's axes (N, 6), shift points (T, 3), and change the lens (2,)."""
        poses = self.world_from_cam.copy()
        poses[:, :3, 3] += cameras[:, :3]
        poses[:, :3, :3] = np.stack([cv2.Rodrigues(turn)[0] for turn in cameras[:, 3:]]) @ poses[:, :3, :3]
        return Bundle(poses, self.points_m + points_m, Lens(*(self.lens.numbers + lens)))


def adjust(
    start: Bundle,
    given: Floats,
    drift: tuple[float, float],
    seen: Observations,
    sigma: float,
    is_lens_free: bool,
    depth_m: Floats | None = None,
    is_fixed: NDArray[np.bool_] | None = None,
) -> Bundle:
    """Move cameras, points and the lens to where points project to what is seen, with Cauchy's weights.

    Args:
        start: the points are the tracks of ``seen``.
        given: ``world_from_cam`` (N, 4, 4).
        drift: how far a camera is from where it was given, in metres and radians along an axis, one standard deviation.
        seen: rays as the claimed intrinsics have them.
        sigma: an observation that is off by so much, in the plane at depth 1, has half the weight.
        is_lens_free: whether the lens is adjusted.
        depth_m: measured along the optical axis, of each observation (O,); NaN where it was not.
        is_fixed: points that stay where they are, (T,); none unless given.
    """
    depth_m = np.full(len(seen), np.nan) if depth_m is None else depth_m
    problem = _Problem(given, drift, seen, sigma, is_lens_free, depth_m)
    if is_fixed is not None:
        problem.is_fixed = is_fixed[seen.track]
    now, cost, damping = start, problem.cost(start), _DAMPING
    for _ in range(_STEPS):
        equations = problem.linearized(now)
        new_cost = np.inf
        while new_cost >= cost and damping < _MOST_DAMPING:
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
        given: Floats,
        drift: tuple[float, float],
        seen: Observations,
        sigma: float,
        is_lens_free: bool,
        depth_m: Floats,
    ) -> None:
        self.given, self.seen, self.sigma = given, seen, sigma
        self.is_fixed = np.zeros(len(seen), bool)
        self.is_measured = np.isfinite(depth_m)
        self.depth_m = np.where(self.is_measured, depth_m, np.inf)[:, None]  # infinite, so that it weighs nothing
        self.least_depth = _LEAST_DEPTH * spread_m(given)
        camera = np.repeat(drift, 3)
        lens = np.array((_FOCAL, _RADIAL)) * (1 if is_lens_free else _FIXED)
        self.prior = np.concatenate((np.tile(camera, len(given)), lens)) ** -2.0
        self.first = np.searchsorted(seen.track, np.arange(seen.track[-1] + 1))

    def cost(self, at: Bundle) -> float:
        off = self._project(at)[0]
        return float(np.log1p((off**2).sum(axis=1)).sum() + (self.moves(at) ** 2 * self.prior).sum())

    def moves(self, at: Bundle) -> Floats:
        """How far cameras and the lens are from where they were given, (6 N + 2,)."""
        return np.concatenate((moves(self.given, at.world_from_cam).ravel(), at.lens.numbers - Lens().numbers))

    def _project(self, at: Bundle) -> tuple[Floats, Floats, Floats, Floats]:
        """Residuals (O, 3), from cameras to points in the world (O, 3), ideal rays (O, 2), and depths (O, 1).

        A residual is two of the ray and one of the depth.
        """
        towards = at.points_m[self.seen.track] - at.world_from_cam[self.seen.frame, :3, 3]
        cam = np.einsum("oji,oj->oi", at.world_from_cam[self.seen.frame, :3, :3], towards)
        depth = np.maximum(cam[:, 2:], self.least_depth)
        ideal = cam[:, :2] / depth
        of_ray = (at.lens.distort(ideal) - self.seen.rays) / self.sigma
        of_depth = np.where(self.is_measured[:, None], (depth / self.depth_m - 1) / _DEPTH, 0.0)
        return np.hstack((of_ray, of_depth)), towards, ideal, depth

    def linearized(self, at: Bundle) -> _Equations:
        """Normal equations at a bundle."""
        off, towards, ideal, depth = self._project(at)
        weight = 1 / np.sqrt(1 + (off**2).sum(axis=1))[:, None, None]
        inverse = at.world_from_cam[self.seen.frame, :3, :3].transpose(0, 2, 1)
        by_ray, by_lens = at.lens.slopes(ideal)
        of_ray = by_ray @ (inverse[:, :2] - ideal[..., None] * inverse[:, 2:]) / depth[..., None] / self.sigma
        by_point = np.concatenate((of_ray, inverse[:, 2:] / (_DEPTH * self.depth_m[..., None])), axis=1)
        by_lens = np.concatenate((by_lens / self.sigma, np.zeros((len(depth), 1, 2))), axis=1)
        # A turn by θ about the world's axes moves a point, as the camera sees it, by -θ x towards.
        by_camera = np.concatenate((-by_point, by_point @ _cross(towards)), axis=-1)
        by_camera, by_lens, by_point = (weight * each for each in (by_camera, by_lens, by_point))
        by_point[self.is_fixed] = 0
        return _Equations(self, by_camera, by_lens, by_point, weight * off[..., None], self.moves(at))


class _Equations:
    """Normal equations in blocks: ``normal`` and ``right`` of cameras and lens, the rest of points."""

    def __init__(
        self, problem: _Problem, by_camera: Floats, by_lens: Floats, by_point: Floats, off: Floats, moves: Floats
    ) -> None:
        self.frame, self.track, self.first = problem.seen.frame, problem.seen.track, problem.first
        self.cameras = len(problem.given)
        self.normal = np.diag(problem.prior)
        self.right = problem.prior * moves
        pose, lens = np.arange(6 * self.cameras).reshape(-1, 6), 6 * self.cameras + np.arange(2)
        rows, columns = pose[self.frame][..., None], pose[self.frame][:, None]
        np.add.at(self.normal, (rows, columns), _t(by_camera) @ by_camera)
        np.add.at(self.normal, (rows, lens[None, None]), _t(by_camera) @ by_lens)
        np.add.at(self.right, pose[self.frame], (_t(by_camera) @ off)[..., 0])
        self.normal[lens[0] :, : lens[0]] = self.normal[: lens[0], lens[0] :].T
        self.normal[np.ix_(lens, lens)] += (_t(by_lens) @ by_lens).sum(axis=0)
        self.right[lens] += (_t(by_lens) @ off).sum(axis=0)[:, 0]
        self.camera_point = _t(by_camera) @ by_point
        self.lens_point = np.add.reduceat(_t(by_lens) @ by_point, self.first)
        self.point_normal = np.add.reduceat(_t(by_point) @ by_point, self.first)
        self.point_right = np.add.reduceat(_t(by_point) @ off, self.first)

    def solve(self, damping: float) -> tuple[Floats, Floats, Floats]:
        """Steps of cameras (N, 6), points (T, 3) and the lens (2,)."""
        trace = np.trace(self.point_normal, axis1=1, axis2=2)
        inverse = np.linalg.inv(self.point_normal + (damping * trace + 1e-9)[:, None, None] * np.eye(3))
        root = np.linalg.cholesky(inverse)
        half, end = _t(root), 6 * self.cameras
        # Points in axes in which their damped normal matrix is the identity.
        blocks = half[self.track] @ _t(self.camera_point), self.frame, np.append(self.first, len(self.track))
        camera = bsr_array(blocks, shape=(3 * len(root), end))
        lens, right = (half @ _t(self.lens_point)).reshape(-1, 2), (half @ self.point_right).ravel()
        normal = self.normal + damping * np.diag(np.diag(self.normal))
        normal[:end, :end] -= (camera.T @ camera).toarray()
        normal[:end, end:] -= camera.T @ lens
        normal[end:, :end] = normal[:end, end:].T
        normal[end:, end:] -= lens.T @ lens
        step = -np.linalg.solve(normal, self.right - np.concatenate((camera.T @ right, lens.T @ right)))
        points = -root @ (right + camera @ step[:end] + lens @ step[end:]).reshape(-1, 3, 1)
        return step[:end].reshape(-1, 6), points[..., 0], step[end:]


def _t(matrices: Floats) -> Floats:
    return matrices.swapaxes(-1, -2)


def _cross(vectors: Floats) -> Floats:
    """Matrices (O, 3, 3) that take the cross product with vectors from the left."""
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    return matrices - _t(matrices)
