"""``frames.csv`` and ``scene.json``: what :mod:`mambaloc.data.datasets.capture` reads, and where all of it is from."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc import provenance
from mambaloc.data.datasets.capture import COLUMNS, FRAMES_FILE, SCENE_FILE, VERSION, VERSION_KEY, WORLD_KEY
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.checks.agreement import Agreement
from mambaloc.importing.checks.findings import Finding, ImportStatus
from mambaloc.importing.splits.selection import RULE, SelectedSplit, SplitCandidate
from mambaloc.runtime.camera_models import CameraModel, model_to_json, numbers_to_json
from mambaloc.runtime.rotations import quaternion_from_matrix

ADJUSTED_FILE = "frames_adjusted.csv"
"""Beside ``frames.csv``, in its form: poses that were adjusted to the images, and the names of cameras that were,
which ``scene.json`` has beside those given. Nothing reads it by itself."""

POSE = (
    "world_from_cam: x, y, z is the camera centre, qw, qx, qy, qz a unit quaternion with qw >= 0; OpenCV camera axes "
    "(x right, y down, z forward)"
)
_UNKNOWN = "unknown: figures that are printed as metres are units of this scene"


@dataclass(frozen=True)
class Imported:
    """A capture as it goes into a scene's folder, and all that was found.

    Args:
        capture: posed images in the folder; positions in the scene's unit and origin.
        lenses: the cameras as the source has them, by name.
        split: of each frame.
        findings: of the checks.
        verdict: what they come to.
        proposals: ways to split; empty where nothing can be split.
        chosen: the one that was taken.
        left_out: the rule that each frame that was left out breaks, by file.
        agreement: how images agree with poses and camera, where they were compared.
        adjusted: poses adjusted to the images, (N, 4, 4), where they were asked for.
    """

    capture: Capture
    lenses: Mapping[str, Camera]
    split: tuple[str, ...]
    findings: tuple[Finding, ...]
    verdict: ImportStatus
    proposals: tuple[SplitCandidate, ...]
    chosen: SelectedSplit | None
    left_out: Mapping[str, str]
    agreement: Agreement | None = None
    adjusted: NDArray[np.float64] | None = None

    @property
    def focal(self) -> Mapping[str, float]:
        """Adjusted focal lengths over those given, by camera."""
        found = None if self.agreement is None else self.agreement.adjusted
        return {} if found is None else found.focal

    @property
    def unit(self) -> str:
        """How a length's unit is written."""
        return "m" if self.capture.unit == "metre" else "units"


def write_frames(imported: Imported, folder: Path) -> None:
    """Write ``frames.csv``, and adjusted poses beside it; numbers as exactly as they are known."""
    _write_poses(imported, imported.capture.world_from_cam, folder, FRAMES_FILE, {})
    if imported.adjusted is not None:
        renamed = {name: _adjusted(name) for name in imported.focal}
        _write_poses(imported, imported.adjusted, folder, ADJUSTED_FILE, renamed)


def _write_poses(
    imported: Imported, world_from_cam: NDArray[np.float64], folder: Path, name: str, renamed: Mapping[str, str]
) -> None:
    capture = imported.capture
    quaternions = quaternion_from_matrix(world_from_cam[:, :3, :3])
    poses = zip(world_from_cam[:, :3, 3].tolist(), quaternions.tolist(), strict=True)
    with (folder / name).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for row, (position, quaternion) in enumerate(poses):
            time_s = "" if capture.time_s is None else repr(float(capture.time_s[row]))
            camera = "" if capture.camera_of is None else capture.camera_of[row]
            camera = renamed.get(camera, camera)
            image = capture.images[row].relative_to(folder).as_posix()
            pose = [repr(number) for number in (*position, *quaternion)]
            writer.writerow([image, capture.sequences[row] or "all", time_s, *pose, camera, imported.split[row]])


def write_scene(imported: Imported, folder: Path, source: Path, command: str) -> None:
    """Write ``scene.json``.

    Args:
        imported: the scene and what was found of it.
        folder: where to.
        source: that it was made of.
        command: that made it.
    """
    capture = imported.capture
    cameras = {name: _described(camera, imported.lenses[name]) for name, camera in capture.cameras.items()}
    for name, scale in imported.focal.items():
        focal_px = [scale * each for each in capture.cameras[name].focal_px]
        cameras[_adjusted(name)] = {**cameras[name], "focal_px": focal_px, "adjusted_from": name}
    content = {
        VERSION_KEY: VERSION,
        "imported": {
            "source": str(source),
            "format": capture.kind,
            "command": command,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "version": provenance.versions()["mambaloc"],
            "commit": provenance.commit(),
        },
        "pose": POSE,
        "unit": "metre" if capture.unit == "metre" else _UNKNOWN,
        WORLD_KEY: asdict(capture.world),
        "choices": dict(capture.choices),
        "cameras": cameras,
        "frames": {
            "used": len(capture.images),
            "poses_without_image": len(capture.poses_without_image),
            "images_without_pose": len(capture.images_without_pose),
            "left_out": dict(imported.left_out),
        },
        "sanity": {
            "verdict": str(imported.verdict),
            "checks": {
                finding.name: {
                    "found": finding.message,
                    **({"concern": finding.concern} if finding.concern else {}),
                    **finding.figures,
                }
                for finding in imported.findings
            },
        },
        "split": _split(imported),
    }
    (folder / SCENE_FILE).write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def _adjusted(camera: str) -> str:
    """The name of a camera once its focal length is adjusted."""
    return f"{camera}_adjusted"


def _described(camera: Camera, lens: Camera) -> dict[str, Any]:
    pinhole = numbers_to_json(camera.size, camera.focal_px, camera.center_px)
    if lens.distorted is None:
        images = "as they were" if lens.size == camera.size else f"the middle of {lens.width}x{lens.height}"
        return {**pinhole, "images": f"{images}: the camera is a pinhole", "model": lens.model}
    was = {"model": lens.model, **numbers_to_json(lens.size, lens.focal_px, lens.center_px)}
    if isinstance(lens.distorted, CameraModel):
        was |= model_to_json(lens.distorted, lens.size)
    else:
        was |= {"opencv": None, "unknown": f"its model, {lens.model}, is not one of OpenCV's"}
    zoom = camera.focal_px[0] / lens.focal_px[0]
    return {**pinhole, "images": f"distortion removed; zoomed by {zoom:.4f}, so that no border is black", "lens": was}


def _split(imported: Imported) -> dict[str, Any]:
    if imported.chosen is None:
        return {"chosen": None, "why": "nothing can be split"}
    return {
        "chosen": imported.chosen.proposal.kind,
        "why": imported.chosen.why,
        **({"warning": imported.chosen.warning} if imported.chosen.warning else {}),
        "rule": RULE,
        "proposals": [proposal.figures() for proposal in imported.proposals],
    }
