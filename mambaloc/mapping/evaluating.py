"""A map measured on the test frames of its scene."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mambaloc import provenance
from mambaloc.console import progress
from mambaloc.data.cameras import frame_intrinsics
from mambaloc.data.datasets.registry import DATASETS, locate, scene_folder
from mambaloc.data.frames import BadFrames, Frames, Split
from mambaloc.files import sha256, whole_file, writing
from mambaloc.images import read_image
from mambaloc.mapping.building import PosedFrames, build_map
from mambaloc.mapping.recipe import MapRecipe
from mambaloc.metrics import summarise_errors
from mambaloc.runtime.maps import MAP_FILE, MapLocaliser, SparseMap
from mambaloc.runtime.maps.radii import LEVEL
from mambaloc.runtime.rotations import matrix_from_quaternion, quaternion_from_matrix, rotation_error_deg

Floats = NDArray[np.float64]

_WRONG = (0.2, 5.0)  # metres and degrees


@dataclass(frozen=True)
class MapErrors:
    """How a map localised frames, a row a frame and RANSAC seed.

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
        """As :func:`~mambaloc.metrics.summarise_errors`, and what becomes of accepted poses.

        ``accepted_and_wrong`` and ``covariance_90`` are shares of accepted poses: of those more than 0.2 m or 5 degrees
        off, and of those whose covariance covers the truth.
        """
        is_wrong = (self.position_m > _WRONG[0]) | (self.rotation_deg > _WRONG[1])
        return {
            **summarise_errors(self.position_m, self.rotation_deg),
            "without_pose": float(np.isinf(self.position_m).mean()),
            "above_20cm": float((self.position_m > _WRONG[0]).mean()),
            "accepted": float(self.is_accepted.mean()),
            "accepted_and_wrong": float((is_wrong & self.is_accepted).sum() / max(self.is_accepted.sum(), 1)),
            "covariance_90": float((self.is_covered & self.is_accepted).sum() / max(self.is_accepted.sum(), 1)),
            "query_cpu_ms": float(1000 * self.cpu_s.mean()),
        }

    def describe(self) -> str:
        """In one line."""
        summary = self.summary()
        return (
            f"median {summary['position_error_m']:.3f} m / {summary['rotation_error_deg']:.2f} deg, "
            f"{100 * summary['recall_10cm_5deg']:.1f} % within 10 cm 5 deg, {100 * summary['accepted']:.1f} % accepted"
        )


def read_frames(recipe: MapRecipe, split: Split) -> PosedFrames:
    """Read a split of a recipe's scene with its cameras.

    Raises:
        InputError: for a scene that cannot be read, or whose cameras are unknown.
    """
    dataset, root, scene = locate(recipe.dataset, recipe.root, recipe.scene)
    folder = scene_folder(dataset, Path(root) if root else None, scene)
    return with_cameras(dataset, folder, DATASETS[dataset].read_split(folder, split, BadFrames()))


def with_cameras(dataset: str, folder: Path, frames: Frames) -> PosedFrames:
    """Add the cameras to frames of a scene.

    Raises:
        InputError: where they are unknown.
    """
    return PosedFrames(frames.image_paths, frame_intrinsics(dataset, folder, frames), _world_from_cam(frames))


def measure(sparse_map: SparseMap, frames: PosedFrames, seeds: Sequence[int]) -> MapErrors:
    """Localise frames in a map, once a seed; time is this process's own on all cores, without decoding the picture."""
    localisers = [MapLocaliser(sparse_map, seed) for seed in seeds]
    rows = []
    for image, intrinsics, truth in progress(
        zip(frames.images, frames.intrinsics, frames.world_from_cam, strict=True), "queries", len(frames)
    ):
        rgb = read_image(image) if isinstance(image, Path) else image
        for localiser in localisers:
            start = time.process_time()
            found = localiser.localise(rgb, intrinsics)
            taken_s = time.process_time() - start
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
    turn = Rotation.from_matrix(truth[:3, :3] @ matrix_from_quaternion(quaternion).T).as_rotvec()
    off = np.concatenate((truth[:3, 3] - np.asarray(position_m), turn))
    return bool(
        off @ np.linalg.pinv(np.asarray(covariance, np.float64), hermitian=True) @ off <= chi2.ppf(LEVEL, len(off))
    )


def build_and_measure(recipe: MapRecipe, out: Path) -> dict[str, Any]:
    """Build a recipe's map from its training frames, measure it on its test frames, and write both to a folder.

    Writes ``map.safetensors`` and ``metrics.json``.

    Returns:
        What ``metrics.json`` holds, with infinity where that has null.

    Raises:
        InputError: as :func:`read_frames` and :func:`~mambaloc.mapping.building.build_map`, and for a folder that
            cannot be written.
    """
    train, test = read_frames(recipe, "train"), read_frames(recipe, "test")
    name = recipe.label or Path(recipe.scene).name
    started, cpu = time.perf_counter(), time.process_time()
    sparse_map = build_map(train, recipe.settings, name)
    core_seconds = time.process_time() - cpu
    sparse_map.save(out / MAP_FILE)
    metrics = measure(sparse_map, test, recipe.ransac_seeds).summary()
    result = {
        "metrics": metrics,
        "label": name,
        "split": "test",
        "count": len(test),
        "ransac_seeds": list(recipe.ransac_seeds),
        "data": {
            "dataset": recipe.dataset,
            "scene": recipe.scene,
            "train_frames": len(train),
            "test_frames": len(test),
        },
        "map": {
            "settings": asdict(recipe.settings),
            "points": len(sparse_map),
            "mib": (out / MAP_FILE).stat().st_size / 2**20,
            "sha256": sha256(out / MAP_FILE),
            "digests": sparse_map.digests,
            "core_seconds": core_seconds,
        },
        "evaluation": {
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "device": provenance.device_name(),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": round(time.perf_counter() - started, 3),
            "seconds_are": "core_seconds and query_cpu_ms are CPU time of the process",
        },
    }
    # JSON has no infinity, which the worst error is where a frame has no pose.
    finite = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
    with writing(out), whole_file(out / "metrics.json") as partial:
        partial.write_text(json.dumps({**result, "metrics": finite}, indent=2) + "\n", encoding="utf-8")
    return result


def describe(result: dict[str, Any]) -> str:
    """A result in one line."""
    metrics, made = result["metrics"], result["map"]
    return (
        f"{result['label']}: median {metrics['position_error_m']:.3f} m / {metrics['rotation_error_deg']:.2f} deg, "
        f"mean {metrics['position_error_mean_m']:.3f} / {metrics['rotation_error_mean_deg']:.2f}, "
        f"worst {metrics['position_error_worst_m']:.2f} m, "
        f"{100 * metrics['recall_10cm_5deg']:.1f} % within 10 cm 5 deg, {made['mib']:.2f} MiB, "
        f"{made['core_seconds']:.1f} core-seconds, {metrics['query_cpu_ms']:.0f} ms a query"
    )


def _world_from_cam(frames: Frames) -> Floats:
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = matrix_from_quaternion(frames.quaternion), frames.position_m
    return poses
