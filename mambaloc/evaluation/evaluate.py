"""Run a checkpoint over a split and write what it measured, with provenance."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mambaloc import provenance
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.evaluation.intervals import BLOCK, LEVEL, block_resamples, median_interval
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.evaluation.recording import record_test_frames
from mambaloc.evaluation.references import frozen_features, median_training_pose, nearest_training_pose, retrieval
from mambaloc.evaluation.trained import Trained, load_trained
from mambaloc.evaluation.trajectories import write_predictions
from mambaloc.evaluation.with_map import Answers, MeasuredMap
from mambaloc.files import atomic_file, writing
from mambaloc.metrics import PoseErrorTable, summarize
from mambaloc.models import Checkpoint, LitPoseRegressor
from mambaloc.models.weights import mib, parameter_count
from mambaloc.nn import PooledBackbone
from mambaloc.runtime.trajectory import write_tum
from mambaloc.uncertainty import uncertainty_of_test
from mambaloc.viz.rerun_recording import check_recording
from mambaloc.viz.trajectory import draw_trajectory


def evaluate_checkpoint(
    checkpoint: Checkpoint,
    out: Path,
    data: PoseDataModule | None = None,
    accelerator: str = "auto",
    with_retrieval: bool = False,
    beside: MeasuredMap | None = None,
    rerun: Path | None = None,
) -> dict[str, Any]:
    """Localize every test frame with a checkpoint and write the result to a folder.

    Writes ``metrics.json``, ``predictions.csv``, ``predictions.tum``, ``ground_truth.tum`` and ``trajectory.png``; with
    a map also ``predictions_both.csv`` and ``predictions_both.tum``, of both together.

    Args:
        checkpoint: of a training.
        out: the folder to write to.
        data: the frames; those of the training recipe unless given.
        accelerator: as Lightning's Trainer takes it.
        with_retrieval: also measure retrieval on the features that the backbone starts with.
        beside: a map of the place, measured on the same frames.
        rerun: a recording to write for the Rerun viewer, ending in ``.rrd``.

    Returns:
        What ``metrics.json`` holds, with infinity where that has null.

    Raises:
        InputError: as :func:`~mambaloc.evaluation.trained.load_trained`, for missing or bad data, or a folder that
            cannot be written.
    """
    if rerun is not None:
        check_recording(rerun)  # fails now rather than once all is computed
    trained = load_trained(checkpoint, data)
    system, data = trained.system, trained.data
    backbone = _first_backbone(checkpoint) if with_retrieval else None
    started = time.perf_counter()
    table = localize_test_frames(system, data, accelerator)
    seconds = time.perf_counter() - started
    both = beside.beside(table, lambda: uncertainty_of_test(system, data)) if beside else None
    result = {
        "metrics": summarize(table),
        **({} if data.scene_index is None else {"recognised": table.position_error_m.isfinite().float().mean().item()}),
        "count": len(table.index),
        "data": data.describe(),
        "split": "test",
        "intervals": median_intervals(table, data.frames("test").sequences),
        **({"map": beside.describe(), "network_and_map": {"metrics": both.summary()}} if beside and both else {}),
        "references": {**_references(data, table), **(_retrieval(backbone, data, table) if backbone else {})},
        "selection": checkpoint.selection,
        "model": _describe_model(system),
        "training": checkpoint.describe(),
        "evaluation": {
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "device": provenance.device_name(system.device.index if system.device.type == "cuda" else None),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": round(seconds, 3),
        },
    }
    _write(out, result, table, both, trained)
    if rerun is not None:
        record_test_frames(rerun, trained, table, beside, both)
    return result


def _references(data: PoseDataModule, table: PoseErrorTable) -> dict[str, dict[str, float]]:
    try:
        listed, chosen = data.listed_training_frames(), data.chosen_training_frames()
    except InputError:  # a test split alone can be measured too
        return {}
    return {
        "median_training_pose": median_training_pose(listed, table),
        "nearest_training_pose": nearest_training_pose(chosen, table),  # of those that were trained on, as in retrieval
    }


def _first_backbone(checkpoint: Checkpoint) -> PooledBackbone:
    """The backbone as the training started from it."""
    arguments = checkpoint.backbone_arguments
    if not arguments["weights"]:
        raise InputError("--retrieval: needs a backbone that started from pretrained weights. Leave it out.")
    return PooledBackbone(**arguments)


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


def _write(out: Path, result: dict[str, Any], table: PoseErrorTable, both: Answers | None, trained: Trained) -> None:
    frames, world = trained.data.frames("test"), trained.data.world
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        with atomic_file(out / "metrics.json") as partial:
            partial.write_text(json.dumps(_finite(result), indent=2) + "\n", encoding="utf-8")
        write_predictions(out / "predictions.csv", table, frames, world)
        true_m = world.position_m(table.true_position_m.cpu())
        write_tum(out / "ground_truth.tum", table.index.tolist(), true_m, table.true_quaternion)
        title = f"{result['model']['name']} on {result['data']['scene']}, test, {trained.chosen} epoch"
        if both is None:
            draw_trajectory(table, frames.sequences, out / "trajectory.png", title)
            return
        write_predictions(out / "predictions_both.csv", both.table, frames, world, both.sources)
        title = f"{result['model']['name']} and map on {result['data']['scene']}, test, {trained.chosen} epoch"
        draw_trajectory(both.table, frames.sequences, out / "trajectory.png", title, table)


def _finite(value: Any) -> Any:
    """JSON has no infinity, which an error is where a map finds no pose."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    return None if isinstance(value, float) and math.isinf(value) else value
