"""The drift of the poses that a map was given: how far they are, by viewpoint, from poses that fit the images.

A map's points and key frames are adjusted to the images. How far each key frame moved is known, and drift is smooth:
a Gaussian process over viewpoints carries any pose from the map's adjusted frame to the frame of the given poses, and
says how sure that is (Rasmussen and Williams 2006, equations 2.23 and 2.24).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.runtime.maps.absolute_pose import CameraPose
from mambaloc.runtime.maps.viewpoints import spread_m, viewpoints

Floats = NDArray[np.floating[Any]]

# Chosen on held-out blocks of a real room: longer is as good, shorter forgets the trend between distant key frames.
_LENGTH = 8.0  # of the kernel, in units of viewpoints
NUGGET = 1e-3
"""Variance of a single key frame's own move, over that of the drift, where poses drift as those of that room do."""
_ONLY_NOISE = 1.0  # the same, of poses that hardly drift


def fit_drift(adjusted: Floats, given: Floats) -> tuple[NDArray[np.float64], float]:
    """Weights of key frames in the drift, and the nugget with which their moves are likelier.

    Where poses were given exactly, all moves are the adjustment's noise, and its variance must not be taken for drift.

    Args:
        adjusted: ``world_from_cam`` of key frames as they fit the images, (K, 4, 4).
        given: the same as they were given.

    Returns:
        Weights (K, 6) of shifts in metres and turns in radians, both along the camera's axes; and the nugget.
    """
    moves = drift_moves(adjusted, given)
    nugget = max((NUGGET, _ONLY_NOISE), key=lambda each: _log_likelihood(adjusted, moves, each))
    return drift_weights(adjusted, moves, nugget), float(nugget)


def drift_moves(adjusted: Floats, given: Floats) -> NDArray[np.float64]:
    """Shifts and turns along the camera's axes, from adjusted to given ``world_from_cam`` (K, 4, 4); (K, 6)."""
    inverse = adjusted[:, :3, :3].transpose(0, 2, 1)
    shifts = (inverse @ (given[:, :3, 3] - adjusted[:, :3, 3])[..., None])[..., 0]
    turns = [cv2.Rodrigues(turn)[0][:, 0] for turn in inverse @ given[:, :3, :3]]
    return np.hstack((shifts, turns))


def drift_weights(adjusted: Floats, moves: Floats, nugget: float) -> NDArray[np.float64]:
    """Weights of key frames of which some moves (K, 6) are known; the others, NaN, weigh nothing."""
    known = np.flatnonzero(np.isfinite(moves[:, 0]))
    weights = np.zeros_like(moves)
    weights[known] = np.linalg.solve(_covariance(adjusted, nugget)[np.ix_(known, known)], moves[known])
    return np.asarray(weights, np.float64)


def known_moves(adjusted: Floats, weights: Floats, nugget: float) -> NDArray[np.float64]:
    """The inverse of :func:`drift_weights`, up to rounding."""
    return np.asarray(np.where(weights.any(axis=1, keepdims=True), _covariance(adjusted, nugget) @ weights, np.nan))


class Drift:
    """Carry poses between the adjusted frame of a map and the frame of the poses that it was given.

    Args:
        key_poses: adjusted ``world_from_cam``, (K, 4, 4).
        weights: of :func:`fit_drift`, (K, 6).
        nugget: with which they were fitted.
    """

    def __init__(self, key_poses: Floats, weights: Floats, nugget: float) -> None:
        self._unit_m = spread_m(key_poses)
        self._places = viewpoints(key_poses, self._unit_m)
        self._weights, self._nugget = weights, nugget
        covariance = _covariance(key_poses, nugget)
        self._inverse = np.linalg.inv(covariance)
        self._amplitude = weights.T @ covariance @ weights / len(weights)  # most likely, (6, 6)

    def to_given(self, pose: CameraPose) -> tuple[CameraPose, Floats]:
        """Carry a pose from the adjusted frame to that of the given poses.

        Returns:
            The pose, and the covariance (6, 6) of what was added, in the order and axes of
            :func:`~mambaloc.runtime.maps.absolute_pose.refine_pose`.
        """
        near = self._near(pose)
        shift, turn = np.split(near @ self._weights, 2)
        carried = CameraPose(pose.rotation @ cv2.Rodrigues(turn)[0], pose.position_m + pose.rotation @ shift)
        axes = np.kron(np.eye(2), pose.rotation)
        unsure = max(1 + self._nugget - float(near @ self._inverse @ near), 0.0)
        return carried, unsure * axes @ self._amplitude @ axes.T

    def to_adjusted(self, pose: CameraPose) -> CameraPose:
        """Carry a pose back, to first order: drift hardly differs between the two."""
        shift, turn = np.split(self._near(pose) @ self._weights, 2)
        rotation = pose.rotation @ cv2.Rodrigues(-turn)[0]
        return CameraPose(rotation, pose.position_m - rotation @ shift)

    def _near(self, pose: CameraPose) -> Floats:
        return _kernel(viewpoints(pose.matrix[None], self._unit_m), self._places)[0]


def _log_likelihood(adjusted: Floats, moves: Floats, nugget: float) -> float:
    """Of moves (K, 6), with the most likely variances of shifts and of turns, up to a constant."""
    covariance = _covariance(adjusted, nugget)
    squares = np.einsum("ki,ki->i", moves, np.linalg.solve(covariance, moves)).reshape(2, 3).sum(axis=1)
    of_moves = 3 * len(moves) * np.log(np.maximum(squares, np.finfo(float).tiny)).sum()
    return -0.5 * float(of_moves + 6 * np.linalg.slogdet(covariance)[1])


def _covariance(key_poses: Floats, nugget: float) -> Floats:
    """Of the moves of key frames, over the variance of the drift, (K, K)."""
    places = viewpoints(key_poses, spread_m(key_poses))
    return _kernel(places, places) + nugget * np.eye(len(places))


def _kernel(places: Floats, others: Floats) -> Floats:
    """Matérn's covariance of smoothness 3/2, (M, 6) and (N, 6) to (M, N)."""
    distance = np.sqrt(3 * ((places[:, None] - others) ** 2).sum(axis=-1)) / _LENGTH
    return np.asarray((1 + distance) * np.exp(-distance))
