"""A video's poses, filtered: constant velocity, outliers left out, frame by frame or over the whole video.

An error-state Kalman filter (Solà 2017, *Quaternion kinematics for the error-state Kalman filter*): the state is
position, velocity, rotation and angular velocity; its error is a vector of 12 whose rotation lies in the camera's own
axes. The smoother goes back over what the filter found (Rauch, Tung and Striebel 1965).
filterpy is not used: its filters have Euclidean states only, and no error state for a rotation.

A network's errors on neighbouring frames are correlated, not white: filtering takes away jitter and leaps, but
little of the error that neighbours share.

Convention
    Poses are ``world_from_cam``; quaternions are wxyz, of either sign and any length. Times are seconds.
    Covariances (12, 12) are of the error: position [m], velocity [m/s], rotation [rad] and angular velocity [rad/s],
    these two in the camera's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import deprecated

from mambaloc.errors import InputError
from mambaloc.runtime.filter_noise import Noise
from mambaloc.runtime.rotations import canonical, multiply, quaternion_from_rotation_vector, rotation_vector_between

Array = NDArray[np.float64]

_POSITION, _VELOCITY, _ROTATION, _TURN = (slice(start, start + 3) for start in range(0, 12, 3))
_MEASURED, _RATES = np.r_[_POSITION, _ROTATION], np.r_[_VELOCITY, _TURN]
_GATE = 22.46  # squared Mahalanobis distance beyond which lies one good pose of a thousand: chi-square, 6 dimensions
_PATIENCE = 5  # poses left out in a row, the last of which is a new beginning
_FIRST_SPEED_M_S, _FIRST_TURN_RAD_S = 2.0, 1.0  # deviations where nothing is known yet: a brisk walk, a quick turn
_LEARNT_EVERY, _LEARNT_FROM = 20, 300  # poses


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A filtered pose, with its rates and how sure they are.

    Shape:
        ``position_m`` (3,); ``quaternion`` (4,) unit, wxyz, ``w >= 0``; ``velocity_m_s`` (3,) along the world's axes;
        ``angular_velocity_rad_s`` (3,), the angular velocity about the camera's axes; ``covariance`` (12, 12).

    Args:
        position_m: camera centre in the scene's frame.
        quaternion: its rotation, wxyz.
        velocity_m_s: rate of the position.
        angular_velocity_rad_s: rate of the rotation.
        covariance: of the error, as the head of this file says.
        is_outlier: the measured pose was left out.
        begins: nothing before this pose counts: it is one of the first, or a jump was believed here.
    """

    position_m: Array
    quaternion: Array
    velocity_m_s: Array
    angular_velocity_rad_s: Array
    covariance: Array
    is_outlier: bool = False
    begins: bool = False

    @property
    @deprecated("PoseEstimate.turn_rad_s is now angular_velocity_rad_s. The old name is removed in the next release.")
    def turn_rad_s(self) -> Array:
        """Angular velocity. Deprecated: removed in the next release."""
        return self.angular_velocity_rad_s


class PoseFilter:
    """Filters poses as they come: each gives the best one at its time, at once, from those until then.

    A pose that is farther from the expected one than the gate allows is left out, and so is one that is not finite; the
    fifth in a row is believed, and the filter begins again with it.

    Args:
        noise: what to believe. Unless given, errors are learned from the last 300 poses, and the first 19 are given
            back as they are.
    """

    def __init__(self, noise: Noise | None = None) -> None:
        self._noise, self._learns = noise, noise is None
        self._seen: list[_Measured] = []
        self._time_s = -np.inf
        self._estimate: PoseEstimate | None = None
        self._left_out = 0

    def update(self, time_s: float, position_m: ArrayLike, quaternion: ArrayLike) -> PoseEstimate:
        """Take a measured pose, give a filtered one.

        Args:
            time_s: not before the last one; at the same time, both measure one pose.
            position_m: (3,).
            quaternion: (4,).

        Raises:
            InputError: where time goes back, a shape is another, or a pose to begin with is not finite.
        """
        measured = _Measured.of(time_s, position_m, quaternion)
        if not (np.isfinite(measured.time_s) and measured.time_s >= self._time_s):
            raise InputError(f"pose at {time_s} s: comes after {self._time_s} s; give poses in order of time")
        if self._learns:
            self._learn(measured)
        if self._estimate is None or self._noise is None:
            estimate = _initial(measured, self._noise or Noise())
        else:
            predicted, _, _ = _predict(self._estimate, measured.time_s - self._time_s, self._noise)
            estimate = _update(predicted, measured, self._noise)
            self._left_out = self._left_out + 1 if estimate.is_outlier else 0
            if self._left_out == _PATIENCE:
                estimate, self._left_out = _initial(measured, self._noise), 0
        self._time_s, self._estimate = measured.time_s, estimate
        return estimate

    def _learn(self, measured: _Measured) -> None:
        self._seen.append(measured)
        if len(self._seen) % _LEARNT_EVERY == 0:
            self._noise = _learned(self._seen)
            del self._seen[:-_LEARNT_FROM]


def smooth(
    time_s: ArrayLike, position_m: ArrayLike, quaternion: ArrayLike, noise: Noise | None = None
) -> list[PoseEstimate]:
    """Filter a whole video: each pose from those before and after it.

    Where a jump is believed, the smoother begins again with the first of the poses that were left out in a row.

    Args:
        time_s: (N,), in order.
        position_m: (N, 3), the first one finite.
        quaternion: (N, 4), the first one finite.
        noise: what to believe; errors are learned from all poses unless given.

    Raises:
        InputError: as :meth:`PoseFilter.update`, or where there are not as many of each.
    """
    columns = np.asarray(time_s), np.asarray(position_m), np.asarray(quaternion)
    if len({len(column) for column in columns}) > 1:
        raise InputError("{} times, {} positions and {} quaternions: give as many of each".format(*map(len, columns)))
    track = [_Measured.of(*row) for row in zip(*columns, strict=True)]
    noise = noise or _learned(track)
    smoothed: list[PoseEstimate] = []
    while rest := track[len(smoothed) :]:
        smoothed += _rts_smooth(_filter_track(rest, noise), rest, noise)
    return smoothed


def _filter_track(track: Sequence[_Measured], noise: Noise) -> list[PoseEstimate]:
    """Filter until a jump; the poses left out before it was believed are the jump's."""
    causal = PoseFilter(noise)
    estimates: list[PoseEstimate] = []
    for measured in track:
        estimate = causal.update(measured.time_s, measured.position_m, measured.quaternion)
        if estimate.begins and estimates:
            return estimates[: 1 - _PATIENCE]
        estimates.append(estimate)
    return estimates


def _rts_smooth(filtered: Sequence[PoseEstimate], track: Sequence[_Measured], noise: Noise) -> list[PoseEstimate]:
    """The backward pass of Rauch, Tung and Striebel, on the error of each pose as filtered."""
    smoothed = [filtered[-1]]
    for k in range(len(filtered) - 2, -1, -1):
        before, after = filtered[k], smoothed[-1]
        predicted, motion, process_noise = _predict(before, track[k + 1].time_s - track[k].time_s, noise)
        gain = np.linalg.solve(predicted.covariance, motion @ before.covariance).T
        kept = np.eye(12) - gain @ motion
        covariance = kept @ before.covariance @ kept.T + gain @ (after.covariance + process_noise) @ gain.T
        turned = rotation_vector_between(predicted.quaternion, after.quaternion)
        rates = (
            after.velocity_m_s - predicted.velocity_m_s,
            after.angular_velocity_rad_s - predicted.angular_velocity_rad_s,
        )
        error = np.concatenate((after.position_m - predicted.position_m, rates[0], turned, rates[1]))
        smoothed.append(_boxplus(before, gain @ error, covariance))
    return smoothed[::-1]


class _Measured(NamedTuple):
    """A measured pose; its quaternion is unit, or NaN where it has no direction."""

    time_s: float
    position_m: Array
    quaternion: Array

    @classmethod
    def of(cls, time_s: float, position_m: ArrayLike, quaternion: ArrayLike) -> _Measured:
        position_m, quaternion = np.array(position_m, np.float64), np.array(quaternion, np.float64)
        if position_m.shape != (3,) or quaternion.shape != (4,):
            shapes = f"{position_m.shape} and {quaternion.shape}"
            raise InputError(f"pose of shapes {shapes}: give a position of (3,) and a quaternion of (4,)")
        with np.errstate(invalid="ignore", over="ignore"):
            return cls(float(time_s), position_m, quaternion / np.sqrt(quaternion @ quaternion))

    @property
    def is_finite(self) -> bool:
        return bool(np.isfinite(self.position_m).all() and np.isfinite(self.quaternion).all())


def _learned(track: Sequence[_Measured]) -> Noise:
    finite = [measured for measured in track if measured.is_finite]
    return Noise.learned(*map(np.array, zip(*finite, strict=True))) if len(finite) >= _LEARNT_EVERY else Noise()


def _initial(measured: _Measured, noise: Noise) -> PoseEstimate:
    if not measured.is_finite:
        raise InputError(f"pose at {measured.time_s} s: not finite, and the filter would begin with it; leave it out")
    deviations = noise.position_m, _FIRST_SPEED_M_S, np.radians(noise.rotation_deg), _FIRST_TURN_RAD_S
    covariance, still = np.diag(np.square(np.repeat(deviations, 3))), np.zeros(3)
    return PoseEstimate(measured.position_m, canonical(measured.quaternion), still, still, covariance, begins=True)


def _predict(estimate: PoseEstimate, step_s: float, noise: Noise) -> tuple[PoseEstimate, Array, Array]:
    """The pose ``step_s`` later, how errors move to it, and the covariance that motion adds; both (12, 12)."""
    turned = estimate.angular_velocity_rad_s * step_s
    motion, process_noise = np.eye(12), np.zeros((12, 12))
    motion[_ROTATION, _ROTATION] = cv2.Rodrigues(-turned)[0]
    motion[_MEASURED, _RATES] = step_s
    white = np.repeat(np.square((noise.acceleration_m_s2, np.radians(noise.acceleration_deg_s2))), 3)
    process_noise[_MEASURED, _MEASURED] = step_s**3 / 3 * white  # integrated over the step
    process_noise[_MEASURED, _RATES] = process_noise[_RATES, _MEASURED] = step_s**2 / 2 * white
    process_noise[_RATES, _RATES] = step_s * white
    moved = replace(
        estimate,
        position_m=estimate.position_m + step_s * estimate.velocity_m_s,
        quaternion=canonical(multiply(estimate.quaternion, quaternion_from_rotation_vector(turned))),
        covariance=motion @ estimate.covariance @ motion.T + process_noise,
        is_outlier=False,
        begins=False,
    )
    return moved, motion, process_noise


def _update(predicted: PoseEstimate, measured: _Measured, noise: Noise) -> PoseEstimate:
    """Take the measured pose in, unless it is an outlier."""
    turned = rotation_vector_between(predicted.quaternion, measured.quaternion)
    innovation = np.concatenate((measured.position_m - predicted.position_m, turned))
    errors = np.diag(np.square(np.repeat((noise.position_m, np.radians(noise.rotation_deg)), 3)))
    information = np.linalg.inv(predicted.covariance[_MEASURED[:, None], _MEASURED] + errors)
    if not innovation @ information @ innovation <= _GATE:  # NaN is not, either
        return replace(predicted, is_outlier=True)
    gain = predicted.covariance[:, _MEASURED] @ information
    kept = np.eye(12)
    kept[:, _MEASURED] -= gain
    covariance = kept @ predicted.covariance @ kept.T + gain @ errors @ gain.T  # Joseph's form: never negative
    return _boxplus(predicted, gain @ innovation, covariance)


def _boxplus(estimate: PoseEstimate, error: Array, covariance: Array) -> PoseEstimate:
    """Put an error (12,) into a state; the covariance keeps its axes, to first order in the rotation (Solà's 6.3)."""
    return replace(
        estimate,
        position_m=estimate.position_m + error[_POSITION],
        velocity_m_s=estimate.velocity_m_s + error[_VELOCITY],
        quaternion=canonical(multiply(estimate.quaternion, quaternion_from_rotation_vector(error[_ROTATION]))),
        angular_velocity_rad_s=estimate.angular_velocity_rad_s + error[_TURN],
        covariance=(covariance + covariance.T) / 2,
    )
