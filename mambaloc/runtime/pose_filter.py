"""A video's poses, filtered: constant velocity, outliers left out, frame by frame or over the whole video.

An error-state Kalman filter (Solà 2017, *Quaternion kinematics for the error-state Kalman filter*): the state is
position, velocity, rotation and angular velocity; its error is a vector of 12 whose rotation lies in the camera's own
axes. The smoother goes back over what the filter found (Rauch, Tung and Striebel 1965).

A network errs alike on frames that look alike, so its errors are not white: filtering takes away jitter and leaps, but
little of the error that neighbours share.

Convention
    Poses are ``world_from_cam``; quaternions are wxyz, of either sign and any length. Times are seconds: those of a
    folder's pictures, which are places in a list, are to be divided by the rate they were taken at.
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

from mambaloc.errors import InputError

Array = NDArray[np.float64]

PICTURES_HZ = 30.0  # what tools take the rate of a folder's pictures to be

_POSITION, _VELOCITY, _ROTATION, _TURN = (slice(start, start + 3) for start in range(0, 12, 3))
_MEASURED, _RATES = np.r_[_POSITION, _ROTATION], np.r_[_VELOCITY, _TURN]
_GATE = 22.46  # squared Mahalanobis distance beyond which lies one good pose of a thousand: chi-square, 6 dimensions
_PATIENCE = 5  # poses left out in a row, the last of which is a new beginning
_FIRST_SPEED_M_S, _FIRST_TURN_RAD_S = 2.0, 1.0  # deviations where nothing is known yet: a brisk walk, a quick turn
_LEARNT_EVERY, _LEARNT_FROM = 20, 300  # poses


@dataclass(frozen=True)
class Noise:
    """What a filter believes of poses and of motion: standard deviations along each axis.

    The defaults of motion are a hand's: what the true trajectories of 7-Scenes' training sequences do in half a second,
    which is much alike in all seven scenes (0.15 to 0.25 m/s², 13 to 25 deg/s²).

    Args:
        position_m: error of a measured position.
        rotation_deg: of a measured rotation.
        acceleration_m_s2: averaged over a second; it is white, so over a quarter of one it is twice as much.
        acceleration_deg_s2: of the rotation, likewise.

    Raises:
        InputError: for one that is no positive number.
    """

    position_m: float = 0.2
    rotation_deg: float = 6.0
    acceleration_m_s2: float = 0.2
    acceleration_deg_s2: float = 15.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < np.inf:
                raise InputError(f"Noise({name}={value}): is a standard deviation; give a positive number")

    @classmethod
    def learned(cls, time_s: Array, position_m: Array, quaternion: Array) -> Noise:
        """What errors a video's poses seem to have where a hand moves the camera.

        A pose's distance from the line between those a quarter of a second before and after shows an error, less what
        motion adds. The far fifth of distances are outliers, and errors are twice what the others show, as much of them
        is common to all three (half or twice as much made little difference on frames held out, and on rendered ones).

        Args:
            time_s: (N,), in order; N is 3 or more.
            position_m: (N, 3), finite.
            quaternion: (N, 4), unit.
        """
        step_s = max(float(np.median(np.diff(time_s))), 1e-6)
        apart = int(np.clip(round(0.25 / step_s), 1, (len(time_s) - 1) // 2))
        first, middle, last = slice(None, -2 * apart), slice(apart, -apart), slice(2 * apart, None)
        before_s, after_s = time_s[middle] - time_s[first], time_s[last] - time_s[middle]
        whole_s = np.maximum(before_s + after_s, 1e-6)
        share = before_s / whole_s
        line_m = position_m[first].T * (1 - share) + position_m[last].T * share
        q_first, q_middle, q_last = quaternion[first].T, quaternion[middle].T, quaternion[last].T
        line = _multiply(q_first, _exp(share * _log(_multiply(_conjugate(q_first), q_last))))
        off_m, off_deg = position_m[middle].T - line_m, np.degrees(_log(_multiply(_conjugate(line), q_middle)))

        errors = 1 + np.median(share**2 + (1 - share) ** 2)  # of three poses, in that of one: variance
        motions = np.median(before_s**2 * after_s**2 / (3 * whole_s))  # of white acceleration, likewise
        found = []
        for off, acceleration in ((off_m, cls.acceleration_m_s2), (off_deg, cls.acceleration_deg_s2)):
            shown = (np.quantile(np.abs(off), 0.8) / 1.2816) ** 2  # four fifths of normal numbers lie within 1.28
            found.append(2 * np.sqrt(max(shown - motions * acceleration**2, shown / 4) / errors))
        # No such model is nearer than these, and poses off by more than 15 degrees are outliers wherever they are many.
        return cls(max(found[0], 0.02), float(np.clip(found[1], 1, 15)))


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A filtered pose, with its rates and how sure they are.

    Shape:
        ``position_m`` (3,); ``quaternion`` (4,) unit, wxyz, ``w >= 0``; ``velocity_m_s`` (3,) along the world's axes;
        ``turn_rad_s`` (3,), the angular velocity about the camera's axes; ``covariance`` (12, 12).

    Args:
        position_m: camera centre in the scene's frame.
        quaternion: likewise.
        velocity_m_s: rate of the position.
        turn_rad_s: rate of the rotation.
        covariance: of the error, as the head of this file says.
        is_outlier: the measured pose was left out.
        begins: nothing before this pose counts: it is one of the first, or a jump was believed here.
    """

    position_m: Array
    quaternion: Array
    velocity_m_s: Array
    turn_rad_s: Array
    covariance: Array
    is_outlier: bool = False
    begins: bool = False


class PoseFilter:
    """Filters poses as they come: each gives the best one at its time, at once, from those until then.

    A pose that is farther from the expected one than the gate allows is left out, and so is one that is not finite; the
    fifth in a row is believed, and the filter begins anew with it.

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
            estimate = _begun(measured, self._noise or Noise())
        else:
            predicted, _, _ = _predicted(self._estimate, measured.time_s - self._time_s, self._noise)
            estimate = _corrected(predicted, measured, self._noise)
            self._left_out = self._left_out + 1 if estimate.is_outlier else 0
            if self._left_out == _PATIENCE:
                estimate, self._left_out = _begun(measured, self._noise), 0
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

    Where a jump is believed, the smoother begins anew with the first of the poses that were left out in a row.

    Args:
        time_s: (N,), in order.
        position_m: (N, 3), the first of them finite.
        quaternion: (N, 4), likewise.
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
        smoothed += _went_back(_followed(rest, noise), rest, noise)
    return smoothed


def _followed(track: Sequence[_Measured], noise: Noise) -> list[PoseEstimate]:
    """Filter until a jump; the poses left out before it was believed are the jump's."""
    causal = PoseFilter(noise)
    estimates: list[PoseEstimate] = []
    for measured in track:
        estimate = causal.update(measured.time_s, measured.position_m, measured.quaternion)
        if estimate.begins and estimates:
            return estimates[: 1 - _PATIENCE]
        estimates.append(estimate)
    return estimates


def _went_back(filtered: Sequence[PoseEstimate], track: Sequence[_Measured], noise: Noise) -> list[PoseEstimate]:
    """The backward pass of Rauch, Tung and Striebel, on the error of each pose as filtered."""
    smoothed = [filtered[-1]]
    for k in range(len(filtered) - 2, -1, -1):
        before, after = filtered[k], smoothed[-1]
        predicted, motion, wander = _predicted(before, track[k + 1].time_s - track[k].time_s, noise)
        gain = np.linalg.solve(predicted.covariance, motion @ before.covariance).T
        kept = np.eye(12) - gain @ motion
        covariance = kept @ before.covariance @ kept.T + gain @ (after.covariance + wander) @ gain.T
        turned = _log(_multiply(_conjugate(predicted.quaternion), after.quaternion))
        rates = after.velocity_m_s - predicted.velocity_m_s, after.turn_rad_s - predicted.turn_rad_s
        error = np.concatenate((after.position_m - predicted.position_m, rates[0], turned, rates[1]))
        smoothed.append(_moved(before, gain @ error, covariance))
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


def _begun(measured: _Measured, noise: Noise) -> PoseEstimate:
    if not measured.is_finite:
        raise InputError(f"pose at {measured.time_s} s: not finite, and the filter would begin with it; leave it out")
    deviations = noise.position_m, _FIRST_SPEED_M_S, np.radians(noise.rotation_deg), _FIRST_TURN_RAD_S
    covariance, still = np.diag(np.square(np.repeat(deviations, 3))), np.zeros(3)
    return PoseEstimate(measured.position_m, _canonical(measured.quaternion), still, still, covariance, begins=True)


def _predicted(estimate: PoseEstimate, step_s: float, noise: Noise) -> tuple[PoseEstimate, Array, Array]:
    """The pose ``step_s`` later, how errors move to it, and the covariance that motion adds; both (12, 12)."""
    turned = estimate.turn_rad_s * step_s
    motion, wander = np.eye(12), np.zeros((12, 12))
    motion[_ROTATION, _ROTATION] = cv2.Rodrigues(-turned)[0]
    motion[_MEASURED, _RATES] = step_s
    white = np.repeat(np.square((noise.acceleration_m_s2, np.radians(noise.acceleration_deg_s2))), 3)
    wander[_MEASURED, _MEASURED] = step_s**3 / 3 * white  # integrated over the step
    wander[_MEASURED, _RATES] = wander[_RATES, _MEASURED] = step_s**2 / 2 * white
    wander[_RATES, _RATES] = step_s * white
    moved = replace(
        estimate,
        position_m=estimate.position_m + step_s * estimate.velocity_m_s,
        quaternion=_canonical(_multiply(estimate.quaternion, _exp(turned))),
        covariance=motion @ estimate.covariance @ motion.T + wander,
        is_outlier=False,
        begins=False,
    )
    return moved, motion, wander


def _corrected(predicted: PoseEstimate, measured: _Measured, noise: Noise) -> PoseEstimate:
    """Take the measured pose in, unless it is an outlier."""
    turned = _log(_multiply(_conjugate(predicted.quaternion), measured.quaternion))
    innovation = np.concatenate((measured.position_m - predicted.position_m, turned))
    errors = np.diag(np.square(np.repeat((noise.position_m, np.radians(noise.rotation_deg)), 3)))
    information = np.linalg.inv(predicted.covariance[_MEASURED[:, None], _MEASURED] + errors)
    if not innovation @ information @ innovation <= _GATE:  # NaN is not, either
        return replace(predicted, is_outlier=True)
    gain = predicted.covariance[:, _MEASURED] @ information
    kept = np.eye(12)
    kept[:, _MEASURED] -= gain
    covariance = kept @ predicted.covariance @ kept.T + gain @ errors @ gain.T  # Joseph's form: never negative
    return _moved(predicted, gain @ innovation, covariance)


def _moved(estimate: PoseEstimate, error: Array, covariance: Array) -> PoseEstimate:
    """Put an error (12,) into a state; the covariance keeps its axes, to first order in the rotation (Solà's 6.3)."""
    return replace(
        estimate,
        position_m=estimate.position_m + error[_POSITION],
        velocity_m_s=estimate.velocity_m_s + error[_VELOCITY],
        quaternion=_canonical(_multiply(estimate.quaternion, _exp(error[_ROTATION]))),
        turn_rad_s=estimate.turn_rad_s + error[_TURN],
        covariance=(covariance + covariance.T) / 2,
    )


def _multiply(a: Array, b: Array) -> Array:
    """Hamilton product: (4, ...), (4, ...) -> (4, ...)."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return np.array(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        )
    )


def _conjugate(quaternion: Array) -> Array:
    return np.array((quaternion[0], *-quaternion[1:]))


def _canonical(quaternion: Array) -> Array:
    """Unit, ``w >= 0``."""
    return quaternion / np.copysign(np.sqrt(quaternion @ quaternion), quaternion[0])


def _exp(rotation_rad: Array) -> Array:
    """The quaternion of a rotation vector: (3, ...) -> (4, ...)."""
    half_rad = np.sqrt((rotation_rad**2).sum(0)) / 2
    return np.array((np.cos(half_rad), *(np.sinc(half_rad / np.pi) / 2 * rotation_rad)))


def _log(quaternion: Array) -> Array:
    """The shortest rotation vector of a unit quaternion of either sign: (4, ...) -> (3, ...)."""
    sine = np.sqrt((quaternion[1:] ** 2).sum(0))
    angle_rad = np.copysign(2 * np.arctan2(sine, np.abs(quaternion[0])), quaternion[0])
    return angle_rad / np.maximum(sine, np.finfo(sine.dtype).tiny) * quaternion[1:]
