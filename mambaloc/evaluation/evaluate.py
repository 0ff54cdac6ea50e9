"""Run a checkpoint over a split and write what it measured, with provenance."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import lightning as L

from mambaloc import provenance
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.evaluation.intervals import BLOCK, LEVEL, block_resamples, median_interval
from mambaloc.evaluation.references import frozen_features, median_training_pose, nearest_training_pose, retrieval
from mambaloc.evaluation.trajectories import write_csv
from mambaloc.files import sha256, whole_file, writing
from mambaloc.metrics import PoseErrorTable, summarise
from mambaloc.models import LitPoseRegressor, load_checkpoint
from mambaloc.models.base import mib, parameter_count, read_checkpoint
from mambaloc.nn import PooledBackbone
from mambaloc.runtime.trajectory import write_tum
from mambaloc.viz import draw_trajectory


def evaluate_checkpoint(
    checkpoint: Path,
    out: Path,
    data: PoseDataModule | None = None,
    accelerator: str = "auto",
    with_retrieval: bool = False,
) -> dict[str, Any]:
    """Localise every test frame with a checkpoint and write the result to a folder.

    Writes ``metrics.json``, ``predictions.csv``, ``predictions.tum``, ``ground_truth.tum`` and ``trajectory.png``.

    Args:
        checkpoint: what a training run wrote.
        out: the folder to write to.
        data: the frames; those of the training recipe unless given.
        accelerator: as Lightning's Trainer takes it.
        with_retrieval: also measure retrieval on the features that the backbone starts with.

    Returns:
        What ``metrics.json`` holds.

    Raises:
        InputError: for a bad checkpoint, missing or bad data, or a folder that cannot be written.
    """
    stored = read_checkpoint(checkpoint)
    system = load_checkpoint(checkpoint)
    data = data or data_of(stored, checkpoint)
    check_image_size(system, data, checkpoint)
    backbone = _first_backbone(stored) if with_retrieval else None
    started = time.perf_counter()
    table = localise_test_frames(system, data, accelerator)
    seconds = time.perf_counter() - started
    result = {
        "metrics": summarise(table),
        "count": len(table.index),
        "data": data.describe(),
        "split": "test",
        "intervals": median_intervals(table, data.frames("test").sequences),
        "references": {**_references(data, table), **(_retrieval(backbone, data, table) if backbone else {})},
        "selection": selection_rule(stored, checkpoint),
        "model": _describe_model(system),
        "training": _describe_training(stored, checkpoint),
        "evaluation": {
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "device": provenance.device_name(system.device.index if system.device.type == "cuda" else None),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": round(seconds, 3),
        },
    }
    _write(out, result, table, data)
    return result


def localise_test_frames(system: LitPoseRegressor, data: PoseDataModule, accelerator: str = "auto") -> PoseErrorTable:
    """Let a system localise every test frame, once and on one device."""
    trainer = L.Trainer(
        accelerator=accelerator,
        devices=1,
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=False,
    )
    trainer.test(system, datamodule=data, verbose=False)
    return system.test_errors.table()


def data_of(stored: dict[str, Any], checkpoint: Path) -> PoseDataModule:
    """Rebuild the data module that a checkpoint was trained with."""
    hparams = {k: v for k, v in stored.get("datamodule_hyper_parameters", {}).items() if not k.startswith("_")}
    if not hparams:
        raise InputError(f"{checkpoint}: holds no data settings; train it with tools/train.py")
    return PoseDataModule(**hparams)


def check_image_size(system: LitPoseRegressor, data: PoseDataModule, checkpoint: Path) -> None:
    """Refuse data whose crops the network was not built for."""
    if data.crop != system.image_size:
        raise InputError(f"data.image_size {data.crop}: {checkpoint} was trained on {system.image_size}; use that")


def selection_rule(stored: dict[str, Any], checkpoint: Path) -> str:
    """Say how this epoch was chosen: a word or two, and for a chosen one the rule after a colon."""
    states = [state for name, state in stored["callbacks"].items() if name.startswith("ModelCheckpoint")]
    monitor = next((state["monitor"] for state in states if state["monitor"]), None)
    if checkpoint.stem == "last" or monitor is None:
        return "last"
    if _validates_on_test(stored):
        return f"best on TEST: lowest {monitor} ON THE TEST SET, so its errors are not those of unseen frames"
    return f"best: lowest {monitor} on frames held out of training"


def _validates_on_test(stored: dict[str, Any]) -> bool:
    return stored.get("datamodule_hyper_parameters", {}).get("validation") == "test_set"


def _references(data: PoseDataModule, table: PoseErrorTable) -> dict[str, dict[str, float]]:
    try:
        listed, chosen = data.listed_training_frames(), data.chosen_training_frames()
    except InputError:  # a test split alone can be measured too
        return {}
    return {
        "median_training_pose": median_training_pose(listed, table),
        "nearest_training_pose": nearest_training_pose(chosen, table),  # of those that were trained on, as in retrieval
    }


def _first_backbone(stored: dict[str, Any]) -> PooledBackbone:
    """The backbone as the training started from it."""
    told = stored["hyper_parameters"]
    if not told.get("backbone_weights"):
        raise InputError("--retrieval: this backbone started from scratch; such features find nothing, leave it out")
    names = ("backbone", "backbone_weights", "backbone_args", "pixel_mean", "pixel_std")
    return PooledBackbone(*(told[name] for name in names))


def _retrieval(backbone: PooledBackbone, data: PoseDataModule, table: PoseErrorTable) -> dict[str, dict[str, float]]:
    data.setup("fit")
    return retrieval(data.frames("train"), *frozen_features(backbone, data), table)


def median_intervals(table: PoseErrorTable, sequences: Sequence[str]) -> dict[str, Any]:
    """The interval of each median by bootstrap over blocks of frames, and how it was drawn.

    Args:
        table: errors of a split.
        sequences: of the split's frames.
    """
    rows = block_resamples([sequences[i] for i in table.index.tolist()])
    errors = {"position_error_m": table.position_error_m, "rotation_error_deg": table.rotation_error_deg}
    medians = {name: list(median_interval(each.cpu().double().numpy(), rows)) for name, each in errors.items()}
    return {"level": LEVEL, "block_frames": BLOCK, **medians}


def _describe_model(system: LitPoseRegressor) -> dict[str, Any]:
    return {
        "name": system.registry_name,
        "parameters": sum(p.numel() for p in system.network.parameters()),
        "mib": round(mib(parameter_count(system.network)), 3),
        "hyperparameters": dict(system.hparams),
    }


def wall_clock_of(stored: dict[str, Any]) -> dict[str, Any] | None:
    """What the wall clock of a checkpoint's training says; None where it had none."""
    return next((state for name, state in stored["callbacks"].items() if name.startswith("WallClock")), None)


def _describe_training(stored: dict[str, Any], checkpoint: Path) -> dict[str, Any]:
    recipe = checkpoint.parent.parent / "config.yaml"
    return {
        **stored["mambaloc"],
        "epoch": stored["epoch"] + 1,
        "step": stored["global_step"],
        "wall_clock": wall_clock_of(stored),
        "recipe": str(recipe) if recipe.is_file() else None,
        "recipe_sha256": sha256(recipe) if recipe.is_file() else None,
        "checkpoint": str(checkpoint),
        "checkpoint_sha256": sha256(checkpoint),
    }


def _write(out: Path, result: dict[str, Any], table: PoseErrorTable, data: PoseDataModule) -> None:
    frames = data.frames("test")
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        with whole_file(out / "metrics.json") as partial:
            partial.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        write_csv(out / "predictions.csv", table, frames)
        write_tum(out / "predictions.tum", table.index.tolist(), table.predicted_position_m, table.predicted_quaternion)
        write_tum(out / "ground_truth.tum", table.index.tolist(), table.true_position_m, table.true_quaternion)
        chosen = result["selection"].split(":")[0]
        title = f"{result['model']['name']} on {result['data']['scene']}, test, {chosen} epoch"
        draw_trajectory(table, frames.sequences, out / "trajectory.png", title)
