"""The manifest of a released model: architecture, weights, input, provenance, and figures with where they are from."""

from __future__ import annotations

from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from mambaloc.errors import InputError
from mambaloc.files import read_yaml

VERSION = 1
MANIFEST_FILE = "manifest.yaml"
WEIGHTS_FILE = "weights.safetensors"


@dataclass(frozen=True)
class Result:
    """Median errors over a set of frames; none of the other fields may be missing.

    Args:
        data: dataset and scene.
        official_split: whether these are the frames of the benchmark of that name.
        split: which frames.
        selection: how the epoch was chosen.
        n: frames.
        position_error_m: median.
        rotation_error_deg: median.
        seed: of the training.
        commit: of the checkout that evaluated it, or ``release VERSION`` of an installed package.
        device: of the evaluation.
        seconds: of training alone.
    """

    data: str
    official_split: bool
    split: str
    selection: str
    n: int
    position_error_m: float
    rotation_error_deg: float
    seed: int
    commit: str
    device: str
    seconds: float


@dataclass(frozen=True)
class Manifest:
    """What ``manifest.yaml`` says.

    Args:
        model: registry name of the system.
        arguments: its hyperparameters.
        scene: dataset and scene that it knows.
        short_side: what images are resized to before the crop, whose size is the system's own.
        pose: frame, units and order of what it says.
        weights_sha256: digest of ``weights.safetensors``, parameters and buffers.
        weights_bytes: its size.
        trained: commit, seed, device and versions of the training, and its recipe's digest.
        results: measured errors.
        licence: of the weights.
        map_sha256: digest of ``map.safetensors``; None where there is no sparse map.
        map_bytes: its size.
        weights_dtype: of the weights' file, ``float32`` or ``float16``.
    """

    model: str
    arguments: dict[str, Any]
    scene: str
    short_side: int
    pose: str
    weights_sha256: str
    weights_bytes: int
    trained: dict[str, Any]
    results: tuple[Result, ...]
    licence: str
    map_sha256: str | None = None
    map_bytes: int | None = None
    weights_dtype: str = "float32"

    def to_yaml(self) -> str:
        """Write the manifest without fields that are None."""
        known = {name: value for name, value in asdict(self).items() if value is not None}
        data = {"manifest": VERSION, **known, "results": [asdict(result) for result in self.results]}
        return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=120)

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Read a released model's manifest.

        Raises:
            InputError: where it is missing or not one, or gives a figure without its provenance.
        """
        path = folder / MANIFEST_FILE
        data = read_yaml(path, "give a released model's folder", "get it again")
        if not isinstance(data, dict) or data.pop("manifest", None) != VERSION:
            raise InputError(f"{path}: expected a manifest of version {VERSION}. Publish the model again.")
        _check(path, "manifest", data, cls)
        results = [_checked_result(path, number, entry) for number, entry in enumerate(data.pop("results"), start=1)]
        return cls(results=tuple(results), **data)


_KINDS: dict[str, Any] = {
    "str": str,
    "str | None": str,
    "int": int,
    "int | None": int,
    "float": (int, float),
    "bool": bool,
    "dict[str, Any]": dict,
    "tuple[Result, ...]": list,
}


def _checked_result(path: Path, number: int, entry: Any) -> Result:
    if not isinstance(entry, dict):
        raise InputError(f"{path}: result {number}: expected a mapping. Publish the model again.")
    _check(path, f"result {number}", entry, Result)
    return Result(**entry)


def _check(path: Path, what: str, data: dict[str, Any], kind: type) -> None:
    """Every field there, unless it may be None, of its type and not empty, and no other."""
    expected = {field.name: _KINDS[str(field.type)] for field in fields(kind)}
    needed = [field.name for field in fields(kind) if field.default is MISSING]
    if missing := [name for name in needed if data.get(name) in (None, "")]:
        raise InputError(f"{path}: {what}: missing field {', '.join(missing)}. Every result states its provenance.")
    if unknown := sorted(set(map(str, data)) - set(expected)):
        raise InputError(
            f"{path}: {what}: unknown field {', '.join(unknown)}. Publish the model again with this version."
        )
    for name, value in data.items():
        types = expected[name]
        if not isinstance(value, types) or (isinstance(value, bool) and types is not bool):
            raise InputError(f"{path}: {what}: {name} is {value!r}, not of its type. Publish the model again.")
