"""A folder that an app ships: models, a map, their contract, and frames with the poses that a port must find."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mambaloc.errors import InputError
from mambaloc.files import sha256
from mambaloc.images import read_image
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.localizer import Localizer
from mambaloc.runtime.maps import MAP_FILE, MapLocalizer, SparseMap
from mambaloc.runtime.rotations import rotation_error_deg

CONTRACT_FILE = "contract.json"

Replay = tuple[float, float, float]
"""Largest deviation of position in millimetres and of rotation in degrees, and median latency in milliseconds."""


@dataclass(frozen=True)
class Deviation:
    """How far one model of a bundle, or its map, is from where it was exported, over the bundle's frames.

    Args:
        file: the model or map.
        position_mm: largest difference of position.
        rotation_deg: largest difference of rotation.
        latency_ms: median of the frames; NaN where there was none to compare.
        within: whether both are at most what the bundle allows.
    """

    file: str
    position_mm: float
    rotation_deg: float
    latency_ms: float
    within: bool


def verify_bundle(folder: Path, threads: int | None = None) -> list[Deviation]:
    """Check every file's digest, and replay the frames through every model, and the map if there is one.

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
            raise InputError(f"{path}: lists the frame {strange} without its digest; write the bundle again")
        if not frames or not any("allowed" in entry for entry in files.values()):
            raise InputError(f"{path}: contains no model, or no frame to check it by; write the bundle again")
        if (in_map := bundle.get("map")) is None:
            return list(_replayed(folder, files, frames, threads))
        if MAP_FILE not in files:
            raise InputError(f"{path}: describes a map without the digest of {MAP_FILE}. Write the bundle again.")
        return [*_replayed(folder, files, frames, threads), _deviation(MAP_FILE, replay_map(folder, frames), in_map)]
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror}); give a bundle's folder") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: is not a bundle's contract ({reason}); write the bundle again") from None


def _check(folder: Path, name: str, digest: str) -> None:
    path, parts = folder / name, PurePosixPath(name).parts
    # By its words, too: who copies the bundle joins them with another folder.
    strange = not parts or ".." in parts or any(character in name for character in "\\:") or name.startswith("/")
    if strange or not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{folder / CONTRACT_FILE}: names {name}, outside of the bundle; do not use it")
    if sha256(path) != digest:
        raise InputError(f"{path}: has another sha256 than the contract. Get the bundle again.")


def _replayed(
    folder: Path, files: dict[str, Any], frames: list[dict[str, Any]], threads: int | None
) -> Iterator[Deviation]:
    for name, entry in files.items():
        if "allowed" not in entry:  # no model
            continue
        yield _deviation(name, replay(folder / name, frames, threads), entry)


def _deviation(file: str, largest: Replay, entry: dict[str, Any]) -> Deviation:
    position_mm, angle_deg, latency_ms = largest
    allowed = entry["allowed"]
    within = position_mm <= allowed["position_mm"] and angle_deg <= allowed["rotation_deg"]
    return Deviation(file, position_mm, angle_deg, latency_ms, bool(within))


def replay(model: Path, frames: list[dict[str, Any]], threads: int | None = None) -> Replay:
    """Let a model localize its bundle's frames: largest deviation in mm and degrees, and median latency in ms."""
    localizer = Localizer(model, threads)
    found = [(localizer.localize(model.parent / frame["file"], frame.get("intrinsics")), frame) for frame in frames]
    in_scene = [  # frames are given in their scene's frame, as the models output them
        (replace(pose, position_m=pose.position_m - localizer.world_of(pose).offset_m), frame) for pose, frame in found
    ]
    return _compared(in_scene)


def replay_map(folder: Path, frames: list[dict[str, Any]]) -> Replay:
    """The same of a bundle's map, over the frames that it localized when the bundle was written."""
    localizer = MapLocalizer(SparseMap.load(folder / MAP_FILE))
    found = []
    for frame in frames:
        if (expected := frame["map"]) is not None:
            rgb, start = read_image(folder / frame["file"]), time.perf_counter()
            pose = localizer.localize(rgb, frame["intrinsics"])
            latency_s = time.perf_counter() - start
            found.append((Localization(pose.position_m, pose.quaternion, latency_s), expected))
    return _compared(found)


def _compared(pairs: Sequence[tuple[Localization, dict[str, Any]]]) -> Replay:
    if not pairs:
        return 0.0, 0.0, float("nan")
    off_mm = [1000 * np.linalg.norm(pose.position_m - np.array(expected["position_m"])) for pose, expected in pairs]
    off_deg = [rotation_error_deg(pose.quaternion, expected["quaternion_wxyz"]) for pose, expected in pairs]
    return float(np.max(off_mm)), float(np.max(off_deg)), 1000 * float(np.median([pose.latency_s for pose, _ in pairs]))
