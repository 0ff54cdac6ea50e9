"""A map measured on the test frames of its scene."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from mambaloc import provenance
from mambaloc.console import progress
from mambaloc.files import atomic_file, sha256, writing
from mambaloc.images import Image, read_image
from mambaloc.mapping.building import PosedFrames, build_map, describe_points
from mambaloc.mapping.posed import read_frames
from mambaloc.mapping.recipe import MapRecipe
from mambaloc.metrics import summarize_errors
from mambaloc.runtime.maps import MAP_FILE, CameraPose, MapLocalization, MapLocalizer, SparseMap
from mambaloc.runtime.maps.radii import LEVEL
from mambaloc.runtime.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_error_deg,
    rotation_vector_from_quaternion,
)

Floats = NDArray[np.float64]

_WRONG = (0.2, 5.0)  # metres and degrees


@dataclass(frozen=True)
class MapErrors:
    """How a map localized frames, a row a frame and RANSAC seed.

    Shape:
        all (N,): errors are infinite where there was no pose.

    Args:
        position_m: errors.
        rotation_deg: errors.
        is_accepted: which poses the map accepts.
        is_covered: which true poses are inside the 90 % ellipsoid of the answer's covariance.
        cpu_s: CPU time of each.
    """

    position_m: Floats
    rotation_deg: Floats
    is_accepted: NDArray[np.bool_]
    is_covered: NDArray[np.bool_]
    cpu_s: Floats

    def summary(self) -> dict[str, float]:
        """As :func:`~mambaloc.metrics.summarize_errors`, and how many poses are accepted and wrong.

        ``accepted_and_wrong`` and ``covariance_90`` are shares of accepted poses: of those more than 0.2 m or 5 degrees
        off, and of those whose covariance covers the truth.
        """
        is_wrong = (self.position_m > _WRONG[0]) | (self.rotation_deg > _WRONG[1])
        return {
            **summarize_errors(self.position_m, self.rotation_deg),
            "without_pose": float(np.isinf(self.position_m).mean()),
            "above_20cm": float((self.position_m > _WRONG[0]).mean()),
            "accepted": float(self.is_accepted.mean()),
            "accepted_and_wrong": float((is_wrong & self.is_accepted).sum() / max(self.is_accepted.sum(), 1)),
            "covariance_90": float((self.is_covered & self.is_accepted).sum() / max(self.is_accepted.sum(), 1)),
            "query_cpu_ms": float(1000 * self.cpu_s.mean()),
        }

    def describe(self) -> str:
        """Median errors and shares, in one line."""
        summary = self.summary()
        return (
            f"median {summary['position_error_m']:.3f} m / {summary['rotation_error_deg']:.2f} deg, "
            f"{100 * summary['recall_10cm_5deg']:.1f} % within 10 cm 5 deg, {100 * summary['accepted']:.1f} % accepted"
        )


def localize_frames(
    localizer: MapLocalizer,
    images: Sequence[Path | Image],
    intrinsics: Floats,
    priors: Sequence[CameraPose | None] | None = None,
) -> tuple[list[MapLocalization], Floats]:
    """Localize images one after another.

    Args:
        localizer: in the map.
        images: N paths or RGB arrays (H, W, 3).
        intrinsics: (N, 3, 3).
        priors: a pose to search around, of each image that has one.

    Returns:
        The answers, and the seconds that each took on one core, without decoding the image, (N,).

    Raises:
        InputError: for a bad image.
    """
    found, cpu_s = [], []
    rows = zip(images, intrinsics, priors or [None] * len(images), strict=True)
    with _on_one_core():
        for image, matrix, prior in progress(rows, "queries", len(images)):
            rgb = read_image(image) if isinstance(image, Path) else image
            start = time.process_time()
            found.append(localizer.localize(rgb, matrix, prior))
            cpu_s.append(time.process_time() - start)
    return found, np.array(cpu_s)


@contextmanager
def _on_one_core() -> Iterator[None]:
    """Keep OpenCV from sharing small images among threads, which takes more CPU time in all."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def measure(sparse_map: SparseMap, frames: PosedFrames, seeds: Sequence[int]) -> MapErrors:
    """Localize frames in a map, once with each RANSAC seed."""
    rows = []
    for seed in seeds:
        answers, cpu_s = localize_frames(MapLocalizer(sparse_map, seed), frames.images, frames.intrinsics)
        for found, taken_s, truth in zip(answers, cpu_s, frames.world_from_cam, strict=True):
            off_m = np.linalg.norm(found.position_m - truth[:3, 3])
            off_deg = rotation_error_deg(found.quaternion, quaternion_from_matrix(truth[:3, :3]))
            inside = covers(found.position_m, found.quaternion, found.covariance, truth)
            rows.append((off_m, off_deg, found.is_accepted, inside, taken_s))
    position_m, rotation_deg, is_accepted, is_covered, cpu_s = (np.array(each) for each in zip(*rows, strict=True))
    position_m, rotation_deg = (np.where(np.isnan(each), np.inf, each) for each in (position_m, rotation_deg))
    return MapErrors(position_m, rotation_deg, is_accepted, is_covered, cpu_s)


def covers(position_m: ArrayLike, quaternion: ArrayLike, covariance: ArrayLike | None, truth: Floats) -> bool:
    """Whether a true pose, (4, 4), is inside the 90 % ellipsoid of an answer's covariance; False without one."""
    if covariance is None or not np.isfinite(covariance).all():
        return False
    turn = quaternion_from_matrix(truth[:3, :3] @ matrix_from_quaternion(quaternion).T)
    off = np.concatenate((truth[:3, 3] - np.asarray(position_m), rotation_vector_from_quaternion(turn)))
    inverse = np.linalg.pinv(np.asarray(covariance, np.float64), hermitian=True)
    return bool(off @ inverse @ off <= chdtri(len(off), 1 - LEVEL))  # chi-squared's quantile


@dataclass(frozen=True)
class Making:
    """How a map was made.

    Args:
        frames: how many there were to choose key frames from.
        settings: of building, or of adding to it.
        core_seconds: CPU time that it took.
        cameras: of these frames. A lens is only fitted where there is one; of several, intrinsics are taken as given.
    """

    frames: int
    settings: dict[str, Any]
    core_seconds: float
    cameras: int = 1


@dataclass(frozen=True)
class MeasuredMap:
    """A map, the test frames that it was measured on, and the result.

    Args:
        sparse_map: the map.
        test: frames.
        errors: how it localized them.
        result: what ``metrics.json`` says, with infinity where that has null.
    """

    sparse_map: SparseMap
    test: PosedFrames
    errors: MapErrors
    result: dict[str, Any]

    def describe(self) -> str:
        """The result in one line."""
        metrics, made = self.result["metrics"], self.result["map"]
        return (
            f"{self.result['label']}: "
            f"median {metrics['position_error_m']:.3f} m / {metrics['rotation_error_deg']:.2f} deg, "
            f"mean {metrics['position_error_mean_m']:.3f} / {metrics['rotation_error_mean_deg']:.2f}, "
            f"worst {metrics['position_error_worst_m']:.2f} m, "
            f"{100 * metrics['recall_10cm_5deg']:.1f} % within 10 cm 5 deg, {made['mib']:.2f} MiB, "
            f"{made['core_seconds']:.1f} core-seconds, {metrics['query_cpu_ms']:.0f} ms a query"
        )


def build_and_measure(recipe: MapRecipe, out: Path) -> MeasuredMap:
    """Build a recipe's map from its training frames, measure it on its test frames, and write both to a folder.

    Writes ``map.safetensors`` and ``metrics.json``.

    Raises:
        InputError: as :func:`~mambaloc.mapping.posed.read_frames` and
            :func:`~mambaloc.mapping.building.build_map`, and for a folder that cannot be written.
    """
    train, test = read_frames(recipe, "train"), read_frames(recipe, "test")
    cpu = time.process_time()
    sparse_map = build_map(train, recipe.settings, recipe.name)
    core_seconds = time.process_time() - cpu
    sparse_map.save(out / MAP_FILE)
    cameras = len(np.unique(train.intrinsics, axis=0))
    making = Making(len(train), asdict(recipe.settings), core_seconds, cameras)
    return measure_saved(out / MAP_FILE, recipe, test, making)


def measure_saved(path: Path, recipe: MapRecipe, test: PosedFrames, making: Making) -> MeasuredMap:
    """Measure a map's file on test frames, and write ``metrics.json`` beside it.

    Args:
        path: the map's file.
        recipe: names the scene and the RANSAC seeds.
        test: frames of it.
        making: how the map was made.

    Raises:
        InputError: for a map or an image that cannot be read, or a folder that cannot be written.
    """
    sparse_map = SparseMap.load(path)
    started = time.perf_counter()
    errors = measure(sparse_map, test, recipe.ransac_seeds)
    result = _result(path, sparse_map, errors, recipe, making, time.perf_counter() - started)
    # JSON has no infinity, which the worst error is where a frame has no pose.
    finite = {name: value if math.isfinite(value) else None for name, value in result["metrics"].items()}
    with writing(path.parent), atomic_file(path.parent / "metrics.json") as partial:
        partial.write_text(json.dumps({**result, "metrics": finite}, indent=2) + "\n", encoding="utf-8")
    return MeasuredMap(sparse_map, test, errors, result)


def _result(
    path: Path, sparse_map: SparseMap, errors: MapErrors, recipe: MapRecipe, making: Making, seconds: float
) -> dict[str, Any]:
    """What ``metrics.json`` says of a map and its errors, which took ``seconds`` to measure."""
    frames = len(errors.position_m) // len(recipe.ransac_seeds)
    return {
        "metrics": errors.summary(),
        "label": recipe.name,
        "split": "test",
        "count": frames,
        "ransac_seeds": list(recipe.ransac_seeds),
        "data": {
            "dataset": recipe.dataset,
            "scene": recipe.scene,
            "train_frames": making.frames,
            "test_frames": frames,
        },
        "map": {
            "settings": making.settings,
            "points": len(sparse_map),
            "points_are": describe_points(sparse_map),
            "cameras": making.cameras,
            "key_frames": len(sparse_map.key_poses),
            "sessions": sparse_map.sessions,
            "mib": path.stat().st_size / 2**20,
            "sha256": sha256(path),
            "digests": sparse_map.digests,
            "core_seconds": making.core_seconds,
        },
        "evaluation": {
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "device": provenance.device_name(),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": round(seconds, 3),
            "seconds_are": "core_seconds and query_cpu_ms are CPU time of the process",
        },
    }
