"""The datasets by name: how each is read, and where it comes from."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mambaloc.data.datasets import cambridge, capture, seven_scenes
from mambaloc.data.download.origins import how_to_get
from mambaloc.data.frames import BadFrames, Frames, Split
from mambaloc.errors import InputError
from mambaloc.user_cache import default_cache_dir

CAPTURE = "capture"
"""Scenes that ``tools/import_scene.py`` made, each named by its folder's path."""


@dataclass(frozen=True)
class Dataset:
    """A kind of dataset: how a split of one of its scenes is read.

    Args:
        read_split: reads a scene's folder.
        official_counts: train and test frames of each official scene; a scene of other counts is not the benchmark's.
        default_root: where its scenes lie unless a recipe says otherwise.
        marks_validation: whether its scenes may have a split ``val``, too.
    """

    read_split: Callable[[Path, Split, BadFrames], Frames]
    official_counts: dict[str, tuple[int, int]]
    default_root: Path
    marks_validation: bool = False


DATASETS: dict[str, Dataset] = {
    "7scenes": Dataset(seven_scenes.read_split, seven_scenes.OFFICIAL_COUNTS, Path("data/7scenes")),
    "cambridge": Dataset(cambridge.read_split, cambridge.OFFICIAL_COUNTS, Path("data/cambridge")),
    "embedded": Dataset(seven_scenes.read_split, {}, default_cache_dir() / "scenes"),
    CAPTURE: Dataset(capture.read_split, {}, Path("scenes"), marks_validation=True),
}


def locate(dataset: str, root: str | None, scene: str) -> tuple[str, str | None, str]:
    """Say what a recipe's ``dataset``, ``root`` and ``scene`` mean, where the scene may be an imported one's path.

    A folder of that name in the root comes first; then, if the name is a path and not a plain name, the folder there.

    Returns:
        The three, changed where the scene is an imported one.
    """
    for folder in (Path(root, scene) if root else None, Path(scene) if Path(scene).name != scene else None):
        if folder is not None and folder.is_dir():
            if not capture.is_captured(folder):
                break
            folder = folder if folder.name not in ("", "..") else folder.resolve()
            return CAPTURE, str(folder.parent), folder.name
    return dataset, root, scene


def scene_folder(dataset: str, root: Path | None, scene: str) -> Path:
    """Find a scene's folder; the embedded scene is rendered there on first use.

    Raises:
        InputError: for an unknown dataset or a scene that is not there, with how to get it.
    """
    if dataset not in DATASETS:
        raise InputError(f"data.dataset {dataset!r}: there is none; choose one of {', '.join(DATASETS)}")
    root = root or DATASETS[dataset].default_root
    if dataset == "embedded":
        from mambaloc.rendering.scenes.embedded import ensure_embedded_scene

        return ensure_embedded_scene(root)
    if not (root / scene).is_dir():
        raise InputError(_how_to_get(dataset, scene, root))
    return root / scene


def _how_to_get(dataset: str, scene: str, root: Path) -> str:
    path = Path(scene) if Path(scene).name != scene else root / scene if dataset == CAPTURE else None
    if path is None and capture.is_captured(Path(scene)):
        return f"{scene} is not in {root}; if you mean the imported scene here, name its path: --data.scene ./{scene}"
    if path is None:
        return how_to_get(dataset, scene, root)
    source, out = (path, Path("scenes", path.name)) if path.is_dir() else ("CAPTURE", path)
    return f"{path}: is no imported scene; make one with: python tools/import_scene.py {source} --out {out}"


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


__all__ = ["CAPTURE", "DATASETS", "Dataset", "is_official", "is_rendered", "locate", "scene_folder"]
