"""Run a checkpoint that knows several scenes over the test split of each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mambaloc.data import MultiSceneDataModule
from mambaloc.evaluation.evaluate import evaluate_checkpoint
from mambaloc.models import Checkpoint


def evaluate_scenes(
    checkpoint: Checkpoint,
    out: Path,
    data: MultiSceneDataModule,
    accelerator: str = "auto",
    with_retrieval: bool = False,
) -> dict[str, dict[str, Any]]:
    """Localize every test frame of every scene, each scene's result in a folder of its own below ``out``.

    The network does not know which scene a frame is of. Where it takes a frame for another scene's, the errors are
    infinite, and means leave it out.

    Args:
        checkpoint: of a training on several scenes.
        out: the folder to write to.
        data: the scenes.
        accelerator: as Lightning's Trainer takes it.
        with_retrieval: also measure retrieval.

    Returns:
        By scene, what :func:`~mambaloc.evaluation.evaluate_checkpoint` returns.

    Raises:
        InputError: as :func:`~mambaloc.evaluation.evaluate_checkpoint`.
    """
    names = [Path(name).name for name in data.scenes]
    folders = names if len(set(names)) == len(names) else [f"{index}_{name}" for index, name in enumerate(names)]
    return {
        name: evaluate_checkpoint(checkpoint, out / folder, scene, accelerator, with_retrieval)
        for name, folder, scene in zip(data.scenes, folders, data.each_scene(), strict=True)
    }
