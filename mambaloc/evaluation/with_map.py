"""Test frames localized in a sparse map: alone, and beside a network."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from mambaloc.data import Frames, PoseDataModule
from mambaloc.data.cameras import frame_intrinsics
from mambaloc.errors import InputError, InputWarning
from mambaloc.files import sha256
from mambaloc.mapping.evaluating import MapErrors, covers, localize_frames
from mambaloc.metrics import PoseErrorTable
from mambaloc.runtime.localization import Localization, combined
from mambaloc.runtime.maps import MAP_FILE, CameraPose, MapLocalization, MapLocalizer, SparseMap
from mambaloc.runtime.rotations import matrix_from_quaternion, rigid_transforms
from mambaloc.uncertainty import Uncertainty

RUN_MAP = Path("map", MAP_FILE)
"""Where a run keeps its map."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Answers:
    """What a map answers about test frames, or a network and a map together.

    Args:
        table: the answers and their errors, a row a frame.
        sources: what gave each, ``map`` or ``network``.
        is_accepted: whether the map accepts each pose, (N,).
        is_covered: which true poses are inside the 90 % ellipsoid of the answer's covariance, (N,).
        cpu_s: CPU time that the map took on all cores, without decoding the image, (N,).
        poses: the answers of a network and a map together, with their radii; none of a map alone.
    """

    table: PoseErrorTable
    sources: list[str]
    is_accepted: NDArray[np.bool_]
    is_covered: NDArray[np.bool_]
    cpu_s: Floats
    poses: list[Localization]

    @classmethod
    def of(cls, found: Sequence[MapLocalization | Localization], frames: Frames, cpu_s: Floats) -> Self:
        """Compare answers with the frames' true poses."""
        truths = rigid_transforms(matrix_from_quaternion(frames.quaternion), frames.position_m)
        pairs = zip(found, truths, strict=True)
        covered = [covers(it.position_m, it.quaternion, it.covariance, truth) for it, truth in pairs]
        sources = ["map" if isinstance(it, MapLocalization) else str(it.source) for it in found]
        is_accepted = np.array([it.is_accepted for it in found])
        poses = [it for it in found if isinstance(it, Localization)]
        return cls(_table(found, frames), sources, is_accepted, np.array(covered), cpu_s, poses)

    def summary(self) -> dict[str, float]:
        """As :meth:`mambaloc.mapping.evaluating.MapErrors.summary`."""
        errors = (self.table.position_error_m.numpy(), self.table.rotation_error_deg.numpy())
        return MapErrors(*errors, self.is_accepted, self.is_covered, self.cpu_s).summary()


@dataclass(frozen=True)
class MeasuredMap:
    """A sparse map, and test frames that were localized in it alone; :func:`measure_map` makes it.

    Args:
        path: the map's file.
        localizer: in the map.
        frames: of the test split.
        intrinsics: of each frame, (N, 3, 3).
        alone: the map's answers, accepted or not.
    """

    path: Path
    localizer: MapLocalizer
    frames: Frames
    intrinsics: Floats
    alone: Answers

    def beside(self, network: PoseErrorTable, uncertainty: Callable[[], Uncertainty | None]) -> Answers:
        """Localize each frame around a network's pose, which is the answer where the map's is not likelier to be right.

        Args:
            network: its answers about the same frames.
            uncertainty: of these, as an exported model states it; None where it states none. Only asked for where the
                map does not accept every pose.
        """
        poses = (network.predicted_position_m.cpu().numpy(), network.predicted_quaternion.cpu().numpy())
        predicted = [Localization(position_m, quaternion, 0.0) for position_m, quaternion in zip(*poses, strict=True)]
        priors = [CameraPose.from_quaternion(each.quaternion, each.position_m) for each in predicted]
        found, cpu_s = localize_frames(self.localizer, self.frames.image_paths, self.intrinsics, priors)
        if not all(each.is_accepted for each in found) and (stated := uncertainty()) is not None:
            predicted = [
                replace(each, position_radius_m=radius_m, rotation_radius_deg=radius_deg, unfamiliarity=unfamiliarity)
                for each, (radius_m, radius_deg, unfamiliarity) in zip(predicted, stated.by_frame(), strict=True)
            ]
        answers = [combined(*both) for both in zip(predicted, found, strict=True)]
        return Answers.of(answers, self.frames, cpu_s)

    def describe(self) -> dict[str, Any]:
        """Which map it is, and how it answered."""
        of = self.localizer.map
        return {
            "metrics": self.alone.summary(),
            "points": len(of),
            "key_frames": len(of.key_poses),
            "width": of.size[0],
            "mib": self.path.stat().st_size / 2**20,
            "sha256": sha256(self.path),
            "digests": of.digests,
            "ransac_seed": self.localizer.seed,
        }


def measure_map(path: Path, data: PoseDataModule) -> MeasuredMap:
    """Localize every test frame in a map.

    Args:
        path: the map's file.
        data: the scene.

    Raises:
        InputError: for a map that cannot be read, frames that are missing or bad, or whose cameras are unknown.
    """
    data.setup("test")
    frames, localizer = data.frames("test"), MapLocalizer(SparseMap.load(path))
    intrinsics = frame_intrinsics(data.hparams["dataset"], data.folder, frames)
    found, cpu_s = localize_frames(localizer, frames.image_paths, intrinsics)
    return MeasuredMap(path, localizer, frames, intrinsics, Answers.of(found, frames, cpu_s))


def measure_map_of_run(run: Path, data: PoseDataModule) -> MeasuredMap | None:
    """Localize every test frame in a run's map; None without one, or, with a warning, where it cannot be used.

    Raises:
        InputError: for frames that are missing or bad.
    """
    path = run / RUN_MAP
    if not path.is_file():
        return None
    data.setup("test")
    try:
        return measure_map(path, data)
    except InputError as error:
        warnings.warn(f"{error} The network is measured without the map.", InputWarning, stacklevel=2)
        return None


def _table(answers: Sequence[MapLocalization | Localization], frames: Frames) -> PoseErrorTable:
    """Poses and their errors, which are infinite where there is no pose."""
    poses = (np.array([each.position_m for each in answers]), np.array([each.quaternion for each in answers]))
    tensors = (torch.from_numpy(each.astype(np.float64)) for each in (*poses, frames.position_m, frames.quaternion))
    table = PoseErrorTable.of(torch.arange(len(frames)), *tensors)
    return replace(
        table,
        position_error_m=table.position_error_m.nan_to_num(nan=math.inf),
        rotation_error_deg=table.rotation_error_deg.nan_to_num(nan=math.inf),
    )
