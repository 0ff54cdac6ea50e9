"""Release a trained system: safetensors, manifest and card, re-measured from what was written."""

from __future__ import annotations

import hashlib
import inspect
import json
import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from safetensors.torch import save
from torch import Tensor

from mambaloc.data import PoseDataModule
from mambaloc.data.datasets.registry import licence_of_weights
from mambaloc.errors import InputError
from mambaloc.evaluation import evaluate_checkpoint
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.export.maps import check_scene
from mambaloc.files import atomic_folder, sha256
from mambaloc.metrics import summarize
from mambaloc.models import Checkpoint
from mambaloc.models.registry import model_class
from mambaloc.runtime.contract import POSE
from mambaloc.runtime.maps import MAP_FILE, SparseMap
from mambaloc.types import height_and_width
from mambaloc.zoo.bundles import map_of
from mambaloc.zoo.loading import load_released
from mambaloc.zoo.manifest import MANIFEST_FILE, WEIGHTS_FILE, Manifest, Result

CARD_FILE = "README.md"
_STARTS = ("backbone_weights", "warm_start")  # the released weights are whole


def publish(path: Path, tag: str, zoo: Path, accelerator: str = "auto", half: bool = False) -> Path:
    """Measure a checkpoint, write it as ``ZOO/ARCH.TAG``, and measure again what was written.

    Args:
        path: of a checkpoint, whose data is still there.
        tag: of the model's name, such as ``7scenes_heads``.
        zoo: the folder that released models are in.
        accelerator: as Lightning's Trainer takes it.
        half: write weights as float16, half the size; they are float32 again once loaded.

    Returns:
        The model's folder; it appears once both measurements agree.

    Raises:
        InputError: for a bad name, a name that is taken, a result without provenance, a run's map that is damaged or of
            another scene, or measurements that differ.
    """
    checkpoint = Checkpoint.read(path)
    folder = zoo / f"{checkpoint.provenance['model']}.{tag}"
    if not re.fullmatch(r"[a-z0-9_]+", tag):
        raise InputError(f"--tag {tag}: may have lower-case letters, digits and underscores only; choose another")
    if folder.exists():
        raise InputError(f"{folder}: already exists; choose another tag")
    system, data, sparse_map = checkpoint.system(), checkpoint.scene_data(), map_of(str(path))
    if sparse_map is not None:
        check_scene(sparse_map, SparseMap.load(sparse_map), data)
    with TemporaryDirectory() as scratch:
        measured = evaluate_checkpoint(checkpoint, Path(scratch), data, accelerator)
    with atomic_folder(folder, "choose another --zoo") as partial:
        if sparse_map is not None:
            shutil.copyfile(sparse_map, partial / MAP_FILE)
        weights = save({name: _written(tensor, half) for name, tensor in system.network.state_dict().items()})
        manifest = Manifest(
            model=system.registry_name,
            arguments={
                k: v for k, v in _plain(dict(system.hparams)).items() if not k.startswith("_") and k not in _STARTS
            },
            scene=f"{data.hparams['dataset']}/{measured['data']['scene']}",
            short_side=data.hparams["short_side"],
            pose=POSE,
            weights_sha256=hashlib.sha256(weights).hexdigest(),
            weights_bytes=len(weights),
            weights_dtype="float16" if half else "float32",
            trained=_plain({**checkpoint.provenance, "recipe_sha256": measured["training"]["recipe_sha256"]}),
            results=(_result(measured),),
            licence=licence_of_weights(data.hparams["dataset"]),
            map_sha256=None if sparse_map is None else sha256(partial / MAP_FILE),
            map_bytes=None if sparse_map is None else (partial / MAP_FILE).stat().st_size,
        )
        (partial / WEIGHTS_FILE).write_bytes(weights)
        (partial / MANIFEST_FILE).write_text(manifest.to_yaml(), encoding="utf-8")
        (partial / CARD_FILE).write_text(card(folder.name, manifest), encoding="utf-8")
        _agree(partial, measured, data, accelerator, tolerance=1e-2 if half else 1e-3)
    return folder


def card(name: str, manifest: Manifest) -> str:
    """A model card in Markdown; what the system is, its own module says."""
    about = inspect.cleandoc(inspect.getmodule(model_class(manifest.model)).__doc__ or "")
    rows = "\n".join(
        f"| {r.data}{'' if r.official_split else ' (no official split)'}, {r.split}, {r.n} frames | {r.selection} | "
        f"{r.position_error_m:.3f} m | {r.rotation_error_deg:.2f}° | {r.seed} | {r.seconds:.0f} s | {r.device} | "
        f"{r.commit if r.commit.startswith('release') else r.commit[:7]} |"
        for r in manifest.results
    )
    trained = "\n".join(f"- {key}: {value}" for key, value in manifest.trained.items() if not isinstance(value, dict))
    height, width = height_and_width(manifest.arguments["image_size"])
    return f"""# {name}

`mambaloc.load("{name}")`: {manifest.model}, which knows the scene {manifest.scene} and no other.

{manifest.pose}. Images are resized to a short side of {manifest.short_side} pixels and cropped in the middle to
{width}x{height}. {manifest.weights_bytes / 2**20:.2f} MiB, {manifest.weights_dtype}.{_map(manifest)}

| data | epoch | median position | median rotation | seed | training | device | commit |
|---|---|---|---|---|---|---|---|
{rows}

## System

{about}

Here with the backbone {manifest.arguments["backbone"]}, GIS: {manifest.arguments["gis"]}.

## Trained

{trained}

## Licence

{manifest.licence}
"""


def _written(tensor: Tensor, half: bool) -> Tensor:
    tensor = tensor.contiguous().cpu()
    return tensor.half() if half and tensor.is_floating_point() else tensor


def _map(manifest: Manifest) -> str:
    if manifest.map_bytes is None:
        return ""
    return f" Beside them a sparse map, {manifest.map_bytes / 2**20:.2f} MiB, which a bundle carries."


def _result(measured: dict[str, Any]) -> Result:
    data, metrics, training = measured["data"], measured["metrics"], measured["training"]
    evaluation, clock = measured["evaluation"], training["wall_clock"]
    if clock is None:
        raise InputError("has no training time. Publish a checkpoint of mambaloc train.")
    return Result(
        data=f"{data['dataset']}/{data['scene']}",
        official_split=bool(data["official_split"]),
        split=measured["split"],
        selection=f"{measured['selection']}, epoch {training['epoch']}",
        n=measured["count"],
        position_error_m=round(metrics["position_error_m"], 6),
        rotation_error_deg=round(metrics["rotation_error_deg"], 6),
        seed=training["seed"],
        commit=evaluation["commit"] or f"release {evaluation['versions']['mambaloc']}",
        device=evaluation["device"],
        seconds=round(clock["train_s"], 1),
    )


def _agree(folder: Path, measured: dict[str, Any], data: PoseDataModule, accelerator: str, tolerance: float) -> None:
    """Refuse what does not find again what was measured."""
    again = summarize(localize_test_frames(load_released(folder), data, accelerator))
    before = measured["metrics"]
    for name in ("position_error_m", "rotation_error_deg"):
        if not abs(again[name] - before[name]) <= tolerance * max(1.0, before[name]):
            raise InputError(f"{folder}: {name} is {again[name]}, where the checkpoint's was {before[name]}; report it")


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """As YAML's safe subset: tuples become lists."""
    return json.loads(json.dumps(values))
