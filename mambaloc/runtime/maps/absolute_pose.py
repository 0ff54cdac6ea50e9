"""The pose of a camera from points and where it sees them: RANSAC, Levenberg-Marquardt, and a covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mambaloc.runtime.rotations import matrix_from_quaternion

Floats = NDArray[np.floating[Any]]

_TRIALS = 1000
_CONFIDENCE = 0.9999
_STEPS = 10
_CONVERGED = 1e-6  # of the cost
_DIAGONAL = np.diag_indices(6)


@dataclass(frozen=True)
class CameraPose:
    """``world_from_cam``: ``rotation`` (3, 3) and ``position_m`` (3,), the camera's centre."""

    rotation: Floats
    position_m: Floats

    @classmethod
    def from_quaternion(cls, quaternion: ArrayLike, position_m: Floats) -> Self:
        """Of a unit quaternion (4,), wxyz."""
        return cls(matrix_from_quaternion(quaternion), position_m)

    @property
    def matrix(self) -> Floats:
        """(4, 4)."""
        return np.concatenate((np.column_stack((self.rotation, self.position_m)), [(0, 0, 0, 1)]))

    def project(self, points_m: Floats) -> tuple[Floats, Floats]:
        """Points (M, 3) in the plane at depth 1, (M, 2), and their depths (M,); NaN where these are not positive."""
        cam = (points_m - self.position_m) @ self.rotation
        depth = np.where(cam[:, 2] > 1e-9, cam[:, 2], np.nan)
        return cam[:, :2] / depth[:, None], depth


def ransac_pose(points_m: Floats, rays: Floats, near: float, rng: np.random.Generator) -> CameraPose | None:
    """Find the pose that most matches agree with, by RANSAC, and SQPnP on those; None if no pose is found.

    Args:
        points_m: (M, 3).
        rays: where they are seen in the plane at depth 1, (M, 2).
        near: how far from its ray, in that plane, a point agrees.
        rng: shuffles the matches, since OpenCV draws from them by a seed of its own.
    """
    if len(points_m) < 4:
        return None
    order = rng.permutation(len(points_m))
    try:
        is_found, rotation, shift, inliers = cv2.solvePnPRansac(
            points_m[order], rays[order], np.eye(3), None,
            iterationsCount=_TRIALS, reprojectionError=near, confidence=_CONFIDENCE, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:  # matches that are all one point, or on a line
        return None
    if not is_found or inliers is None or not np.isfinite(rotation).all() or not np.isfinite(shift).all():
        return None
    cam_from_world = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
    return CameraPose(cam_from_world.T, -cam_from_world.T @ shift[:, 0])


def refine_pose(start: CameraPose, points_m: Floats, rays: Floats, near: float) -> CameraPose:
    """Least squares of all matches with Cauchy's weights, by Levenberg-Marquardt.

    Args:
        start: a pose from which the points lie in front.
        points_m: (M, 3), M of 4 or more.
        rays: (M, 2) in the plane at depth 1.
        near: a match that is off by half of it has half the weight.
    """
    pose, damping = start, 1e-4
    cost, normal, right = _normal_equations(pose, points_m, rays, near)
    for _ in range(_STEPS):
        damped = normal.copy()
        damped[_DIAGONAL] += damping * normal[_DIAGONAL] + 1e-12
        moved = _moved(pose, np.linalg.solve(damped, right))
        new = _normal_equations(moved, points_m, rays, near)
        if new[0] <= cost:
            has_converged = cost - new[0] <= _CONVERGED * cost
            pose, damping, (cost, normal, right) = moved, damping / 10, new
            if has_converged:
                break
        else:
            damping *= 10
    return pose


def pose_covariance(pose: CameraPose, points_m: Floats, rays: Floats, near: float) -> Floats:
    """Covariance of a pose of :func:`refine_pose`; points, rays and ``near`` are those that it was refined with.

    Returns:
        (6, 6), of the position in metres, then of the rotation in radians about the fixed axes of the world
        (``R = exp(θ) R_estimated``), as ROS's PoseWithCovariance has it; all infinite where a point lies behind the
        camera. It is the sandwich of an M-estimator, ``H^-1 (Σ g g^T) H^-1`` of the cost's Hessian and each match's
        gradient (Huber 1967): Cauchy's weights are not variances, so the inverse of the normal equations is too small
        where residuals are as large as their scale.
    """
    linear = _linearized(pose, points_m, rays, near)
    if linear is None:
        return np.full((6, 6), np.inf)
    off, jacobian, _ = linear
    weight = 1 / (1 + (off**2).sum(axis=0))
    gradient = (jacobian * off).sum(axis=1) * weight
    squares = gradient @ gradient.T
    hessian = (jacobian * weight).reshape(6, -1) @ jacobian.reshape(6, -1).T - 2 * squares
    inverse = np.linalg.pinv(hessian, hermitian=True)
    freedom = off.size / max(off.size - 6, 1)
    axes = np.kron(np.eye(2), pose.rotation) @ inverse
    return np.asarray(freedom * axes @ squares @ axes.T)


def focal_scale(pose: CameraPose, points_m: Floats, rays: Floats, near: float) -> tuple[float, float]:
    """How much longer than given the focal length is: a Gauss-Newton step of pose and focal length together.

    Args:
        pose: of :func:`refine_pose`, with the same points, rays and ``near``.
        points_m: (M, 3), M of 4 or more.
        rays: (M, 2) in the plane at depth 1.
        near: as there.

    Returns:
        The scale, 1 where the intrinsics fit, and its standard deviation, which is infinite where nothing says.
    """
    linear = _linearized(pose, points_m, rays, near)
    if linear is None:
        return 1.0, np.inf
    off, jacobian, seen = linear
    square = (off**2).sum(axis=0)
    weight = 1 / (1 + square)
    jacobian = np.concatenate((jacobian, (seen * (2 / near))[None]))
    weighted = (jacobian * weight).reshape(7, -1)
    inverse = np.linalg.pinv(weighted @ jacobian.reshape(7, -1).T, hermitian=True)
    variance = inverse[6, 6] * float(weight @ square) / max(off.size - 7, 1)
    step = float(np.clip(-inverse[6] @ weighted @ off.ravel(), -1, 1))
    return float(np.exp(step)), float(np.sqrt(variance)) if variance > 0 else np.inf


def _moved(pose: CameraPose, step: Floats) -> CameraPose:
    """Shifted and turned along the camera's axes."""
    return CameraPose(pose.rotation @ cv2.Rodrigues(step[3:])[0], pose.position_m + pose.rotation @ step[:3])


def _linearized(pose: CameraPose, points_m: Floats, rays: Floats, near: float) -> tuple[Floats, Floats, Floats] | None:
    """Residuals in halves of ``near`` (2, M), their slopes (6, 2, M) by steps of :func:`_moved`, and where points are
    seen (2, M).

    None where a point lies behind the camera.
    """
    cam = pose.rotation.T @ (points_m - pose.position_m).T
    if (cam[2] <= 1e-9).any():
        return None
    unit, seen = 2 / near, cam[:2] / cam[2]
    shift = unit / cam[2]
    (x, y), zero, product = seen, np.zeros(len(points_m)), unit * seen[0] * seen[1]
    jacobian = np.array(
        (
            (-shift, zero),
            (zero, -shift),
            shift * seen,
            (product, unit + unit * y**2),
            (-unit - unit * x**2, -product),
            (unit * y, -unit * x),
        )
    )
    return (seen - rays.T) * unit, jacobian, seen


def _normal_equations(pose: CameraPose, points_m: Floats, rays: Floats, near: float) -> tuple[float, Floats, Floats]:
    """Cost, ``J^T W J`` (6, 6) and ``-J^T W r`` (6,)."""
    linear = _linearized(pose, points_m, rays, near)
    if linear is None:
        return np.inf, np.eye(6), np.zeros(6)
    off, jacobian, _ = linear
    square = (off**2).sum(axis=0)
    weighted = (jacobian / (1 + square)).reshape(6, -1)
    return float(np.log1p(square).sum()), weighted @ jacobian.reshape(6, -1).T, -weighted @ off.ravel()
