"""A folder that an app ships: models, their contract, and frames with the poses that a port must find."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mambaloc.errors import InputError
from mambaloc.files import sha256
from mambaloc.runtime.localiser import Localiser
from mambaloc.runtime.rotations import rotation_error_deg

CONTRACT_FILE = "contract.json"


@dataclass(frozen=True)
class Deviation:
    """How far one model of a bundle is from the system it was exported from, over the bundle's frames.

    Args:
        file: the model.
        position_mm: largest difference of position.
        rotation_deg: largest difference of rotation.
        latency_ms: median of the frames.
        within: whether both are at most what the bundle allows.
    """

    file: str
    position_mm: float
    rotation_deg: float
    latency_ms: float
    within: bool


def verify_bundle(folder: Path, threads: int | None = None) -> list[Deviation]:
    """Check every file's digest, and replay the frames through every model.

    Raises:
        InputError: where a file is missing or not the one that was written, or something cannot be read.
    """
    path = folder / CONTRACT_FILE
    try:
        bundle = json.loads(path.read_text(encoding="utf-8"))
        files, frames = dict(bundle["files"]), list(bundle["frames"])
        for name, entry in files.items():
            _check(folder, name, entry["sha256"])
        if strange := next((frame["file"] for frame in frames if frame["file"] not in files), None):
            raise InputError(f"{path}: speaks of the frame {strange}, but not of its digest; write the bundle anew")
        if not frames or not any("allowed" in entry for entry in files.values()):
            raise InputError(f"{path}: holds no model, or no frame to check it by; write the bundle anew")
        return list(_replayed(folder, files, frames, threads))
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror}); give a bundle's folder") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: is no bundle's contract ({reason}); write the bundle anew") from None


def _check(folder: Path, name: str, digest: str) -> None:
    path, parts = folder / name, PurePosixPath(name).parts
    # By its words, too: who copies the bundle joins them with another folder.
    strange = not parts or ".." in parts or any(character in name for character in "\\:") or name.startswith("/")
    if strange or not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{folder / CONTRACT_FILE}: names {name}, outside of the bundle; do not use it")
    if sha256(path) != digest:
        raise InputError(f"{path}: is not the file that the bundle was written with (sha256 differs); get it anew")


def _replayed(
    folder: Path, files: dict[str, Any], frames: list[dict[str, Any]], threads: int | None
) -> Iterator[Deviation]:
    for name, entry in files.items():
        if "allowed" not in entry:  # no model
            continue
        position_mm, angle_deg, latency_ms = replay(folder / name, frames, threads)
        allowed = entry["allowed"]
        within = position_mm <= allowed["position_mm"] and angle_deg <= allowed["rotation_deg"]
        yield Deviation(name, position_mm, angle_deg, latency_ms, within)


def replay(model: Path, frames: list[dict[str, Any]], threads: int | None = None) -> tuple[float, float, float]:
    """Let a model localise its bundle's frames: largest deviation in mm and degrees, and median latency in ms."""
    localiser = Localiser(model, threads)
    found = [localiser.localise(model.parent / frame["file"]) for frame in frames]
    pairs = list(zip(found, frames, strict=True))
    position_mm = max(1000 * float(np.linalg.norm(p.position_m - np.array(frame["position_m"]))) for p, frame in pairs)
    angle_deg = max(float(rotation_error_deg(p.quaternion, frame["quaternion_wxyz"])) for p, frame in pairs)
    return position_mm, angle_deg, 1000 * float(np.median([pose.latency_s for pose in found]))
