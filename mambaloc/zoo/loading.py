"""Load a trained system from wherever it is: a checkpoint, a released model's name, a folder, a hub."""

from __future__ import annotations

import hashlib
import re
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from huggingface_hub import snapshot_download
from safetensors import SafetensorError
from safetensors.torch import load as tensors_of

from mambaloc.errors import InputError, suggestion
from mambaloc.files import shipped_folder
from mambaloc.models import Checkpoint, LitPoseRegressor, registry
from mambaloc.runtime.maps import MAP_FILE
from mambaloc.zoo.manifest import MANIFEST_FILE, WEIGHTS_FILE, Manifest

_ZOO = shipped_folder("zoo")

_SOURCES = "Sources are a checkpoint, 'ARCH.TAG', 'local-dir:FOLDER' and 'hf-hub:ORG/NAME@REVISION'."


def list_released() -> list[str]:
    """Names of the released models that are here, ``ARCH.TAG``, sorted."""
    return sorted(manifest.parent.name for manifest in _ZOO.glob(f"*/{MANIFEST_FILE}"))


def list_models(pattern: str = "*", pretrained: bool = False) -> list[str]:
    """Names that match a wildcard, sorted.

    Args:
        pattern: such as ``"*loc*"``.
        pretrained: list released models, ``ARCH.TAG``, in place of architectures.
    """
    if not pretrained:
        return registry.list_models(pattern)
    return [name for name in list_released() if fnmatch(name, pattern)]


def create_model(name: str, pretrained: bool = False, **kwargs: Any) -> LitPoseRegressor:
    """Build a model: untrained from its architecture's name, or with the weights of a released one.

    Args:
        name: an architecture of :func:`list_models`; with ``pretrained``, an ``ARCH.TAG``.
        pretrained: load the released weights; the model is then in evaluation mode, as :func:`load` returns it.
        kwargs: hyperparameters of an untrained model. A released model keeps its own.

    Raises:
        InputError: for an unknown name; for hyperparameters beside ``pretrained``; as :func:`load`.
    """
    if not pretrained:
        return registry.create_model(name, **kwargs)
    if kwargs:
        raise InputError(f"{name}: a released model keeps its hyperparameters. Leave out {', '.join(kwargs)}.")
    return load_released(released_folder(name))


def load(source: str | Path) -> LitPoseRegressor:
    """Load a trained system in evaluation mode on the CPU; nothing is ever unpickled but plain tensors.

    Args:
        source: ``RUN/checkpoints/best.ckpt``; ``ARCH.TAG`` of a released model; ``local-dir:FOLDER`` with a manifest;
            or ``hf-hub:ORG/NAME@REVISION``, which is kept and found again without a network.

    Raises:
        InputError: where there is no such model, its manifest or digest is wrong, or it is of another architecture.
    """
    if is_checkpoint(source):
        return Checkpoint.read(source).system()
    return load_released(released_folder(str(source)))


def is_checkpoint(source: str | Path) -> bool:
    """Whether :func:`load` takes a source for a checkpoint, even one that is missing, rather than a released model."""
    return Path(source).suffix == ".ckpt" or Path(source).is_file()


def released_folder(source: str) -> Path:
    """The folder of a released model: ``ARCH.TAG``, ``local-dir:FOLDER``, or ``hf-hub:ORG/NAME@REVISION``.

    Raises:
        InputError: if there is no model of this name.
    """
    kind, colon, rest = source.partition(":")
    if colon and kind == "local-dir":
        return Path(rest)
    if colon and kind == "hf-hub":
        return _from_hub(rest)
    if re.fullmatch(r"[a-z0-9_]+\.[a-z0-9_]+", source) and (_ZOO / source / MANIFEST_FILE).is_file():
        return _ZOO / source
    raise InputError(f"{source}: no such model. {suggestion(source, list_released())} {_SOURCES}")


def load_released(folder: Path) -> LitPoseRegressor:
    """Load the model that a manifest speaks of.

    Raises:
        InputError: as :func:`load`.
    """
    manifest, path = Manifest.read(folder), folder / WEIGHTS_FILE
    content = _released_bytes(path, manifest.weights_sha256)
    try:
        system = registry.create_model(
            manifest.model, **{**manifest.arguments, "backbone_weights": None, "warm_start": None}
        )
        system.network.load_state_dict(tensors_of(content))
    except (SafetensorError, RuntimeError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[-1].strip()
        raise InputError(f"{path}: does not fit {manifest.model} as the manifest describes it ({reason})") from None
    trained_on = {"short_side": manifest.short_side, **manifest.trained.get("data", {})}
    system.provenance = {**manifest.trained, "data": trained_on}
    return system.eval()


def released_map(folder: Path) -> Path | None:
    """The sparse map that was released with a model, its digest checked; None without one.

    Raises:
        InputError: where the manifest is wrong, or the file is missing or another.
    """
    digest, path = Manifest.read(folder).map_sha256, folder / MAP_FILE
    if digest is None:
        return None
    _released_bytes(path, digest)
    return path


def _released_bytes(path: Path, digest: str) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); get the model again") from None
    if hashlib.sha256(content).hexdigest() != digest:
        raise InputError(f"{path}: has another sha256 than its manifest. Get the model again.")
    return content


def _from_hub(name: str) -> Path:
    repository, at, revision = name.partition("@")
    if not at or not revision:
        raise InputError(f"hf-hub:{name}: names no revision, so it may change; give hf-hub:{repository}@REVISION")
    files = [MANIFEST_FILE, WEIGHTS_FILE, MAP_FILE]
    try:
        return Path(snapshot_download(repository, revision=revision, allow_patterns=files))
    except Exception as online:  # the hub's client raises its own errors, its transport's, and the system's
        try:
            kept = snapshot_download(repository, revision=revision, allow_patterns=files, local_files_only=True)
            return Path(kept)
        except Exception:
            reason = f"{type(online).__name__}: {str(online).splitlines()[0]}" if str(online) else type(online).__name__
            raise InputError(f"hf-hub:{name}: cannot be fetched, and is not kept from before ({reason})") from None
