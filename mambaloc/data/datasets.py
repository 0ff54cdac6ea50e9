"""The datasets by name: how each is read, and where it comes from."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mambaloc.data import cambridge, seven_scenes
from mambaloc.data.download.origins import how_to_get
from mambaloc.data.frames import BadFrames, Frames, Split
from mambaloc.errors import InputError
from mambaloc.user_cache import default_cache_dir


@dataclass(frozen=True)
class Dataset:
    """A kind of dataset: how a split of one of its scenes is read.

    Args:
        read_split: reads a scene's folder.
        official_counts: train and test frames of each official scene; a scene of other counts is not the benchmark's.
        default_root: where its scenes lie unless a recipe says otherwise.
    """

    read_split: Callable[[Path, Split, BadFrames], Frames]
    official_counts: dict[str, tuple[int, int]]
    default_root: Path


DATASETS: dict[str, Dataset] = {
    "7scenes": Dataset(seven_scenes.read_split, seven_scenes.OFFICIAL_COUNTS, Path("data/7scenes")),
    "cambridge": Dataset(cambridge.read_split, cambridge.OFFICIAL_COUNTS, Path("data/cambridge")),
    "embedded": Dataset(seven_scenes.read_split, {}, default_cache_dir() / "scenes"),
}


def scene_folder(dataset: str, root: Path | None, scene: str) -> Path:
    """Find a scene's folder; the embedded scene is rendered there on first use.

    Raises:
        InputError: for an unknown dataset or a scene that is not there, with how to get it.
    """
    if dataset not in DATASETS:
        raise InputError(f"data.dataset {dataset!r}: there is none; choose one of {', '.join(DATASETS)}")
    root = root or DATASETS[dataset].default_root
    if dataset == "embedded":
        from mambaloc.data.rendering.embedded import ensure_embedded_scene

        return ensure_embedded_scene(root)
    if not (root / scene).is_dir():
        raise InputError(how_to_get(dataset, scene, root))
    return root / scene


def is_rendered(folder: Path) -> bool:
    """Whether a scene's ``scene.json`` says that it was rendered: no benchmark's pictures, whatever its poses."""
    try:
        note = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(note, dict) and "rendered_by" in note


def is_official(dataset: str, scene: str, listed: dict[str, int]) -> bool:
    """Whether the splits read so far (``train``, ``test``) have the frame counts of the official benchmark."""
    official = DATASETS[dataset].official_counts.get(scene)
    if official is None or not listed:
        return False
    return all(official[split == "test"] == count for split, count in listed.items())


__all__ = ["DATASETS", "Dataset", "is_official", "is_rendered", "scene_folder"]
