"""Our map beside pycolmap's own route: the same key frames, the same images, in turns."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from maps_colmap import ColmapRoute, WrittenImages
from maps_robustness import Answers, score
from maps_scenes import key_and_query, timed_map
from numpy.typing import NDArray

from mambaloc import provenance
from mambaloc.benchmark.footprint import in_a_process
from mambaloc.errors import InputError
from mambaloc.files import atomic_file, writing
from mambaloc.images import read_image
from mambaloc.mapping.keyframes import farthest_first
from mambaloc.mapping.recipe import MapRecipe
from mambaloc.runtime.maps import MAP_FILE, MapLocalizer
from mambaloc.runtime.rotations import quaternion_from_matrix

Floats = NDArray[np.float64]
Scores = list[tuple[float, float, bool, float]]


@dataclass(frozen=True)
class Turn:
    """One route built and asked once.

    Args:
        scores: of each query: errors in metres and degrees, whether accepted, CPU seconds.
        build_cpu_s: CPU seconds of the process, on all threads, to build from the images.
        bytes: that must be shipped.
        points: triangulated.
    """

    scores: Scores
    build_cpu_s: float
    bytes: int
    points: int


def measure_beside_colmap(recipe: MapRecipe, hold_out: str | None, out: Path) -> str:
    """Build and ask both routes, once a RANSAC seed, and write ``colmap.md`` and ``colmap.json`` to a folder.

    Args:
        recipe: scene, key frames, width, and seeds; all frames must have one camera.
        hold_out: as :func:`maps_scenes.key_and_query` takes it.
        out: the folder.

    Returns:
        The table, in Markdown.

    Raises:
        InputError: as building a map; where frames have several cameras; where pycolmap is missing or crashes.
    """
    train, queries = key_and_query(recipe, hold_out)
    key = train.select(farthest_first(train.world_from_cam, recipe.settings.key_frames))
    if np.ptp(np.concatenate((key.intrinsics, queries.intrinsics)), axis=0).any():
        raise InputError(f"{recipe.scene}: has several cameras. Choose a scene of one.")
    turns: dict[str, list[Turn]] = {"ours": [], "pycolmap": []}
    with TemporaryDirectory() as folder, writing(out):
        out.mkdir(parents=True, exist_ok=True)
        shown_key, shown_queries = (
            WrittenImages.write(frames, recipe.settings.width, Path(folder, name))
            for name, frames in (("key", key), ("query", queries))
        )
        for seed in recipe.ransac_seeds:
            turns["ours"].append(_ours(shown_key, shown_queries, recipe, seed, out))
            work = Path(folder, f"colmap{seed}")
            work.mkdir()
            try:
                turns["pycolmap"].append(in_a_process(_theirs, shown_key, shown_queries, work, seed))
            except BrokenProcessPool:
                raise InputError(f"{recipe.scene}: pycolmap crashed. Try fewer frames, or another version.") from None
    result = {
        "label": recipe.label or Path(recipe.scene).name,
        "settings": asdict(recipe.settings),
        "frames": {"key": len(key), "queries": len(queries)},
        "split": hold_out or "test",
        "routes": {name: _summary(of) for name, of in turns.items()},
        "commit": provenance.commit(),
        "versions": provenance.versions() | {"pycolmap": _pycolmap_version()},
        "machine": provenance.machine(),
    }
    text = _table(result)
    for name, content in (("colmap.json", json.dumps(result, indent=2) + "\n"), ("colmap.md", text)):
        with writing(out), atomic_file(out / name) as partial:
            partial.write_text(content, encoding="utf-8")
    return text


def _ours(key: WrittenImages, queries: WrittenImages, recipe: MapRecipe, seed: int, out: Path) -> Turn:
    settings = replace(recipe.settings, key_frames=len(key))
    sparse_map, build_cpu_s = timed_map(key.frames, replace(recipe, settings=settings))
    sparse_map.save(out / MAP_FILE)
    localizer, scores = MapLocalizer(sparse_map, seed), []
    for name, truth in zip(queries.names, queries.world_from_cam, strict=True):
        start = time.process_time()
        found = localizer.localize(read_image(queries.folder / name), queries.intrinsics)  # theirs reads the file, too
        scores.append(score(found, found.is_accepted, time.process_time() - start, truth))
    return Turn(scores, build_cpu_s, (out / MAP_FILE).stat().st_size, len(sparse_map))


def _theirs(key: WrittenImages, queries: WrittenImages, work: Path, seed: int) -> Turn:
    """In a process of its own, which a crash ends."""
    route, start = ColmapRoute(key, work, seed), time.process_time()
    route.build()
    build_cpu_s, start = time.process_time() - start, time.process_time()
    poses = route.localize(queries)
    each_s = (time.process_time() - start) / len(queries)
    scores = [_score(pose, each_s, truth) for pose, truth in zip(poses, queries.world_from_cam, strict=True)]
    return Turn(scores, build_cpu_s, route.bytes(), int(route.model.num_points3D()))


def _score(pose: NDArray[Any] | None, cpu_s: float, truth: Floats) -> tuple[float, float, bool, float]:
    return *errors_of_pose(pose, truth), False, cpu_s


def errors_of_pose(pose: NDArray[Any] | None, truth: Floats) -> tuple[float, float]:
    """Metres and degrees between two poses ``world_from_cam`` (4, 4); infinite without one."""
    if pose is None:
        return np.inf, np.inf
    position_m, rotation_deg, *_ = score(_Found(pose[:3, 3], quaternion_from_matrix(pose[:3, :3])), False, 0.0, truth)
    return position_m, rotation_deg


@dataclass(frozen=True)
class _Found:
    position_m: NDArray[Any]
    quaternion: NDArray[Any]


def _summary(turns: Sequence[Turn]) -> dict[str, Any]:
    answers = Answers.of(np.array([turn.scores for turn in turns]))
    return {
        **answers.summary(),
        "within_10cm_5deg": float(((answers.position_m <= 0.1) & (answers.rotation_deg <= 5)).mean()),
        "build_cpu_s": float(np.median([turn.build_cpu_s for turn in turns])),
        "mib": turns[0].bytes / 2**20,
        "points": turns[0].points,
    }


_ROWS = {
    "median": lambda of: f"{of['position_error_m']:.3f} m, {of['rotation_error_deg']:.2f}°",
    "mean": lambda of: f"{of['position_error_mean_m']:.3f} m, {of['rotation_error_mean_deg']:.2f}°",
    "worst": lambda of: f"{of['position_error_worst_m']:.2f} m",
    "above 0.2 m": lambda of: f"{100 * of['above_20cm']:.1f} %",
    "within 10 cm 5°": lambda of: f"{100 * of['within_10cm_5deg']:.1f} %",
    "size": lambda of: f"{of['mib']:.2f} MiB",
    "built in": lambda of: f"{of['build_cpu_s']:.1f} core-s",
    "a query": lambda of: f"{of['query_cpu_ms']:.0f} ms",
}


def _table(result: dict[str, Any]) -> str:
    settings = result["settings"]
    lines = [f"| {result['frames']['key']} key frames, {settings['width']} px wide | " + " | ".join(_ROWS) + " |"]
    lines.append("|---" * (1 + len(_ROWS)) + "|")
    for name, of in result["routes"].items():
        lines.append(f"| {name} | " + " | ".join(show(of) for show in _ROWS.values()) + " |")
    return "\n".join((*lines, ""))


def _pycolmap_version() -> str:
    from importlib.metadata import version

    return version("pycolmap")
