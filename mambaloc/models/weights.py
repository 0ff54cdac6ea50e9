"""Trained weights: read from checkpoints without unpickling, put into networks and systems, counted."""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import lightning as L
import torch
from torch import nn

from mambaloc.errors import InputError
from mambaloc.models.scene_tables import rows_of_scenes
from mambaloc.nn import PoseNetwork

_System = TypeVar("_System", bound=L.LightningModule)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint's plain data onto the CPU.

    Raises:
        InputError: where the file is missing, unreadable, or holds anything but tensors and plain data.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such checkpoint; a training run writes them to RUN/checkpoints/")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        reason = next((line for line in str(error).splitlines() if "GLOBAL" in line), "not plain tensors").strip()
        raise InputError(f"{path}: refused, since loading it could run code ({reason}); use a trusted export") from None
    except Exception as error:  # torch's unpickler fails on broken files with KeyError, IndexError, struct.error, ...
        raise InputError(
            f"{path}: cannot be read as a checkpoint ({type(error).__name__}). Check that it is complete."
        ) from None
    ours = checkpoint.get("mambaloc") if isinstance(checkpoint, dict) else None
    if not isinstance(ours, dict) or "model" not in ours:
        raise InputError(f"{path}: not a MambaLoc checkpoint; give one that a training run wrote")
    return checkpoint


def start_from(network: PoseNetwork, path: str | Path, scenes: Sequence[str] = ()) -> list[str]:
    """Copy the weights of a checkpoint's network.

    Args:
        network: which has the weights afterwards.
        path: of the checkpoint.
        scenes: names of those that the network learns, where there are several. Of the weights that have rows for each
            scene it gets those of scenes that the checkpoint's network knows.

    Returns:
        Names of the scenes that the checkpoint's network knows, in their order.

    Raises:
        InputError: where there is no such checkpoint, or its network is another one.
    """
    prefix = "network."
    try:
        stored = read_checkpoint(path)
    except InputError as error:
        raise InputError(f"model.warm_start: {error}; train it first, or set it to null") from None
    known = stored.get("hyper_parameters", {}).get("scenes") or [_only_scene(stored)]
    state = {k.removeprefix(prefix): v for k, v in stored["state_dict"].items() if k.startswith(prefix)}
    try:
        if network.scenes > 1 and list(scenes) != known:
            state |= rows_of_scenes(network, state, known, scenes)
        network.load_state_dict(state)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise InputError(
            f"model.warm_start: {path}: has another network ({reason}); train it with this recipe's model arguments"
        ) from None
    return known


def _only_scene(stored: dict[str, Any]) -> str:
    return str(stored.get("datamodule_hyper_parameters", {}).get("scene", ""))


def build_from(stored: dict[str, Any], cls: type[_System], strict: bool = True, **changed: Any) -> _System:
    """Build a trained system on the CPU.

    Backbone weights are in the checkpoint, so whatever started the training is not looked for again.

    Args:
        stored: what :func:`read_checkpoint` returned.
        cls: the system's class.
        strict: whether weights that are missing or left over are an error.
        changed: hyperparameters that replace the stored ones.
    """
    # Without Lightning's own notes on the class: which one to build is not the file's to say.
    arguments = {name: value for name, value in stored.get("hyper_parameters", {}).items() if not name.startswith("_")}
    arguments |= dict.fromkeys({"backbone_weights", "warm_start"} & set(arguments))
    if "new_scenes_only" in arguments:  # of a training, whose other scenes were warm_start's
        arguments["new_scenes_only"] = False
    arguments |= changed
    taken = inspect.signature(cls).parameters
    if not any(each.kind is each.VAR_KEYWORD for each in taken.values()):  # else a base class takes the others
        arguments = {name: value for name, value in arguments.items() if name in taken}
    system = cls(**arguments)
    system.on_load_checkpoint(stored)
    system.load_state_dict(stored["state_dict"], strict=strict)
    return system


def parameter_count(network: nn.Module) -> int:
    """Count the trainable parameters."""
    return sum(p.numel() for p in network.parameters() if p.requires_grad)


def mib(parameters: int) -> float:
    """Size of so many parameters as float32, in MiB: what the paper prints as "Mb"."""
    return parameters * 4 / 2**20
