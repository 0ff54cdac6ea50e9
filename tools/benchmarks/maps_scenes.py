"""A scene's map and network, made and measured together."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from maps_report import summarize, table, write_result
from maps_robustness import measure

from mambaloc.errors import InputError
from mambaloc.export import contract_of, export_onnx
from mambaloc.files import writing
from mambaloc.mapping.building import PosedFrames, build_map
from mambaloc.mapping.posed import read_frames
from mambaloc.mapping.recipe import MapRecipe
from mambaloc.models import Checkpoint
from mambaloc.runtime import Localizer
from mambaloc.runtime.maps import MAP_FILE, SparseMap


def measure_robustness(
    recipe: MapRecipe,
    checkpoint: Path | None,
    training_cpu_s: float | None,
    hold_out: str | None,
    unit: str,
    out: Path,
) -> str:
    """Build a map, export a network, measure both under every disturbance, and write the result to a folder.

    Args:
        recipe: scene and settings of the map.
        checkpoint: of a network of the same scene; only the map is measured without one.
        training_cpu_s: what its training took; it is only written down.
        hold_out: a sequence of the training frames to measure on, see :func:`key_and_query`.
        unit: of the scene's positions.
        out: the folder.

    Returns:
        The table, in Markdown.

    Raises:
        InputError: as reading a scene, building a map and reading a checkpoint.
    """
    train, queries = key_and_query(recipe, hold_out)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    sparse_map, map_cpu_s = timed_map(train, recipe)
    sparse_map.save(out / MAP_FILE)
    network, about_network = _network(checkpoint, training_cpu_s, out / "model.onnx") if checkpoint else (None, None)
    cv2.setNumThreads(1)
    found = measure(sparse_map, network, queries, recipe.ransac_seeds)
    about = {
        "label": f"{recipe.label or Path(recipe.scene).name}, {len(sparse_map.key_poses)} key frames",
        "unit": unit,
        "split": f"{hold_out} held out of training frames" if hold_out else "test",
        "frames": {"train": len(train), "queries": len(queries)},
        "ransac_seeds": list(recipe.ransac_seeds),
        "map": {
            "settings": asdict(recipe.settings),
            "points": len(sparse_map),
            "bytes": (out / MAP_FILE).stat().st_size,
            "preparation_cpu_s": map_cpu_s,
        },
        "network": about_network,
    }
    result = summarize(found, [str(sequence_of(image)) for image in queries.images], about)
    write_result(result, found, out)
    return table(result)


def key_and_query(recipe: MapRecipe, hold_out: str | None) -> tuple[PosedFrames, PosedFrames]:
    """Frames to build from and frames to localize: training and test frames, or of the training frames alone.

    Args:
        recipe: names the scene.
        hold_out: name of the folder of a sequence; its frames are localized, and the map is built from the others. To
            decide anything, so that test frames are left for the end.

    Raises:
        InputError: as :func:`~mambaloc.mapping.posed.read_frames`, and where no frame is in that folder.
    """
    train = read_frames(recipe, "train")
    if hold_out is None:
        return train, read_frames(recipe, "test")
    is_held = np.array([sequence_of(image).name == hold_out for image in train.images])
    if not is_held.any() or is_held.all():
        names = sorted({sequence_of(image).name for image in train.images})
        raise InputError(f"--hold-out {hold_out}: does not name a part of the training frames. They are in {names}.")
    return train.select(np.flatnonzero(~is_held)), train.select(np.flatnonzero(is_held))


def sequence_of(image: Any) -> Path:
    """The folder of a frame."""
    return Path(image).parent


def timed_map(train: PosedFrames, recipe: MapRecipe) -> tuple[SparseMap, float]:
    """Build a recipe's map; and the CPU seconds of this process that it took, on all threads."""
    start = time.process_time()
    sparse_map = build_map(train, recipe.settings, recipe.label or Path(recipe.scene).name)
    return sparse_map, time.process_time() - start


def _network(path: Path, training_cpu_s: float | None, onnx: Path) -> tuple[Localizer, dict[str, Any]]:
    """Export a checkpoint, for one thread; and what it is."""
    checkpoint = Checkpoint.read(path)
    system = checkpoint.system()
    export_onnx(system, onnx, contract_of(system, checkpoint.data().hparams))
    about = {
        "model": system.registry_name,
        "selection": checkpoint.selection,
        "bytes": onnx.stat().st_size,
        "preparation_cpu_s": training_cpu_s,
        "training": checkpoint.describe(),
    }
    return Localizer(onnx, threads=1, sparse_map=False), about
