"""A network, a sparse map, and both together on the same images, undisturbed and disturbed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from maps_disturbances import DISTURBANCES
from numpy.typing import NDArray

from mambaloc.console import progress
from mambaloc.images import read_image
from mambaloc.mapping.building import PosedFrames
from mambaloc.runtime import Localizer
from mambaloc.runtime.localization import combined
from mambaloc.runtime.maps import CameraPose, MapLocalizer, SparseMap
from mambaloc.runtime.maps.features import rescaled_intrinsics
from mambaloc.runtime.rotations import quaternion_from_matrix, rotation_error_deg

Floats = NDArray[np.float64]
T = TypeVar("T")

FAR_M, FAR_DEG = 0.2, 5.0
"""A pose is wrong that is farther off than either."""

_Z = 1.959964  # of a 95 % interval


@dataclass(frozen=True)
class Answers:
    """How one way localized frames, a row a RANSAC seed; a network has one row.

    Shape:
        all (S, N); errors are infinite where there was no pose.

    Args:
        position_m: errors.
        rotation_deg: errors.
        is_accepted: whether the pose is the map's, and its rule accepts it.
        cpu_s: CPU time of this process on all threads, without decoding the image.
    """

    position_m: Floats
    rotation_deg: Floats
    is_accepted: NDArray[np.bool_]
    cpu_s: Floats

    @classmethod
    def of(cls, scores_SNC: Floats) -> Answers:
        """Put together what :func:`score` gave, (S, N, 4)."""
        position_m, rotation_deg, is_accepted, cpu_s = np.moveaxis(scores_SNC, -1, 0)
        return cls(position_m, rotation_deg, is_accepted.astype(bool), cpu_s)

    @property
    def is_wrong(self) -> NDArray[np.bool_]:
        """Farther off than 0.2 m or 5 degrees."""
        return (self.position_m > FAR_M) | (self.rotation_deg > FAR_DEG)

    def summary(self) -> dict[str, Any]:
        """Medians and shares count frames without a pose as infinitely wrong; means leave them out."""
        has_pose, seeds = np.isfinite(self.position_m), len(self.position_m)
        wrong, accepted = (self.is_wrong & self.is_accepted).sum() / seeds, self.is_accepted.sum() / seeds
        return {
            "position_error_m": float(np.median(self.position_m)),
            "rotation_error_deg": float(np.median(self.rotation_deg)),
            "position_error_mean_m": _mean(self.position_m[has_pose]),
            "rotation_error_mean_deg": _mean(self.rotation_deg[has_pose]),
            "position_error_worst_m": float(self.position_m.max()),
            "rotation_error_worst_deg": float(self.rotation_deg.max()),
            "above_20cm": float((self.position_m > FAR_M).mean()),
            "above_5deg": float((self.rotation_deg > FAR_DEG).mean()),
            "wrong": float(self.is_wrong.mean()),
            "without_pose": float((~has_pose).mean()),
            "accepted": float(self.is_accepted.mean()),
            "accepted_and_wrong": float(wrong / max(accepted, 1e-9)),
            "accepted_and_wrong_interval": wilson_interval(wrong, accepted),
            "query_cpu_ms": float(1000 * self.cpu_s.mean()),
        }


def measure(
    sparse_map: SparseMap, network: Localizer | None, frames: PosedFrames, seeds: Sequence[int]
) -> dict[str, dict[str, Answers]]:
    """Localize frames under every disturbance, by each way.

    Args:
        sparse_map: the map.
        network: an exported model of the same scene; without one, only the map is measured.
        frames: with their true poses.
        seeds: of RANSAC; each frame is localized once with each.

    Returns:
        By disturbance, then by way: ``map``, and with a network ``network`` and ``both``.
    """
    localizers = [MapLocalizer(sparse_map, seed) for seed in seeds]
    found = {}
    for number, (name, disturb) in enumerate(DISTURBANCES.items()):
        rows: dict[str, list[Floats]] = {}
        shots = list(zip(frames.images, frames.intrinsics, frames.world_from_cam, strict=True))
        for row, (image, intrinsics, truth) in enumerate(progress(shots, f"{name:24}", len(shots))):
            rgb = read_image(image) if isinstance(image, Path) else image
            image = disturb(rgb, np.random.default_rng((number, row)))
            sizes = ((each.shape[1], each.shape[0]) for each in (rgb, image))
            matrix = rescaled_intrinsics(intrinsics, *sizes)
            for way, answers in _localize(localizers, network, image, matrix).items():
                scores = [score(answer, is_accepted, cpu_s, truth) for answer, is_accepted, cpu_s in answers]
                rows.setdefault(way, []).append(np.array(scores))
        found[name] = {way: Answers.of(np.stack(each, axis=1)) for way, each in rows.items()}
    return found


def _localize(
    localizers: Sequence[MapLocalizer], network: Localizer | None, image: Any, intrinsics: Floats
) -> dict[str, list[tuple[Found, bool, float]]]:
    """Each way's answers, whether they are accepted, and what they took; an answer a seed, of a network one."""
    found: dict[str, list[tuple[Found, bool, float]]] = {}
    guess, network_s, prior = None, 0.0, None
    if network:
        guess, network_s = _timed(network.localize, image)
        prior = CameraPose.from_quaternion(guess.quaternion, guess.position_m)
        found["network"] = [(guess, False, network_s)]
    for localizer in localizers:
        alone, alone_s = _timed(localizer.localize, image, intrinsics)
        found.setdefault("map", []).append((alone, alone.is_accepted, alone_s))
        if guess:
            guided, guided_s = _timed(localizer.localize, image, intrinsics, prior)
            both = combined(guess, guided)
            found.setdefault("both", []).append((both, both.is_accepted, network_s + guided_s))
    return found


def _timed(work: Callable[..., T], *args: Any) -> tuple[T, float]:
    start = time.process_time()
    done = work(*args)
    return done, time.process_time() - start


class Found(Protocol):
    """A pose ``world_from_cam``, NaN without one."""

    @property
    def position_m(self) -> NDArray[Any]:
        """Camera centre, (3,)."""

    @property
    def quaternion(self) -> NDArray[Any]:
        """Unit, wxyz, (4,)."""


def score(found: Found, is_accepted: bool, cpu_s: float, truth: Floats) -> tuple[float, float, bool, float]:
    """A column of :class:`Answers`: errors of one pose against ``world_from_cam`` (4, 4)."""
    off_m = float(np.linalg.norm(found.position_m - truth[:3, 3]))
    off_deg = float(rotation_error_deg(found.quaternion, quaternion_from_matrix(truth[:3, :3])))
    return (off_m, off_deg, is_accepted, cpu_s) if np.isfinite(off_m) else (np.inf, np.inf, False, cpu_s)


def compare(both: Answers, other: Answers, resamples: NDArray[np.int64]) -> dict[str, tuple[float, float, float]]:
    """How much worse ``both`` is than ``other`` on the same frames, with the 95 % interval of the difference.

    Args:
        both: answers to N frames.
        other: answers to the same.
        resamples: rows of frames, (R, N), as
            :func:`~mambaloc.evaluation.intervals.block_resamples` draws them; both are resampled alike.

    Returns:
        Difference, low, high of the median errors, and of the share of wrong poses.
    """
    return {
        "position_error_m": _difference(both.position_m, other.position_m, resamples, np.median),
        "rotation_error_deg": _difference(both.rotation_deg, other.rotation_deg, resamples, np.median),
        "wrong": _difference(both.is_wrong, other.is_wrong, resamples, np.mean),
    }


def _difference(
    a: NDArray[Any], b: NDArray[Any], resamples: NDArray[np.int64], statistic: Callable[..., Any]
) -> tuple[float, float, float]:
    def resampled(of_SN: NDArray[Any]) -> Floats:
        return statistic(of_SN[:, resamples], axis=(0, 2))

    differences = np.sort(resampled(a) - resampled(b))
    low, high = differences[[int(0.025 * len(differences)), int(0.975 * len(differences))]]
    return float(statistic(a) - statistic(b)), float(low), float(high)


def wilson_interval(hits: float, trials: float) -> tuple[float, float]:
    """The 95 % interval of a share (Wilson 1927), from 0 to 1 where there was no trial."""
    if trials <= 0:
        return 0.0, 1.0
    share, square = hits / trials, _Z**2 / trials
    middle = (share + square / 2) / (1 + square)
    half = _Z / (1 + square) * np.sqrt(share * (1 - share) / trials + square / (4 * trials))
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def save_answers(found: Mapping[str, Mapping[str, Answers]], path: Path) -> None:
    """Keep every frame's errors: an array a disturbance, way and field."""
    arrays = {
        f"{name}/{way}/{field.name}": getattr(answers, field.name)
        for name, ways in found.items()
        for way, answers in ways.items()
        for field in fields(answers)
    }
    np.savez_compressed(path, **arrays)


def _mean(errors: Floats) -> float:
    return float(errors.mean()) if len(errors) else float("inf")
