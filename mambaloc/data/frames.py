"""Posed frames of a split, and what is done with a bad one."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.renamed import renamed_arguments

Split = Literal["train", "val", "test"]
"""Imported scenes mark frames for validation; the benchmarks have none."""
OnBadFrame = Literal["error", "skip"]

FARTHEST = 1e7
"""Largest coordinate of a camera, in whatever unit a scene has: beyond, float32 is off by one unit."""

FARTHEST_M = 1e5
"""Largest coordinate in a place that is measured in metres: a label or a point beyond is an error or noise."""

UNIT_TOLERANCE = 1e-3
"""How far a quaternion's length may be from 1, where a file's decimals have rounded it."""

ROTATION_TOLERANCE = 1e-2
"""How far entries of ``R R^T`` may be from the identity's, where a file's decimals have rounded a rotation ``R``."""


@dataclass(frozen=True)
class Rejection:
    """A frame, or a part of one, that breaks a rule."""

    path: Path
    rule: str


@dataclass
class BadFrames:
    """Decide what a bad frame does: stop the run, or be left out and counted.

    Args:
        policy: ``error`` raises at the first bad frame; ``skip`` records it.
    """

    policy: OnBadFrame = "error"
    rejected: list[Rejection] = field(default_factory=list)
    repaired: list[Rejection] = field(default_factory=list)

    def reject(self, path: Path, rule: str) -> None:
        """Leave a frame out.

        Raises:
            InputError: under the policy ``error``.
        """
        if self.policy == "error":
            raise InputError(f"{path}: {rule}; repair or remove it, or leave it out with on_bad_frame: skip")
        self.rejected.append(Rejection(path, rule))

    def repair(self, path: Path, rule: str) -> None:
        """Record a frame that was repaired and kept."""
        self.repaired.append(Rejection(path, rule))

    def counts(self) -> dict[str, int]:
        """How many frames broke each rule."""
        return dict(Counter(rejection.rule for rejection in self.rejected))


@dataclass(frozen=True)
class Frames:
    """Posed images in the order they were taken, sequence after sequence.

    Shape:
        ``image_paths`` and ``sequences`` hold N entries; ``position_m`` is (N, 3), ``quaternion`` (N, 4),
        canonical wxyz: ``world_from_cam``, float64.
    """

    image_paths: tuple[Path, ...]
    sequences: tuple[str, ...]
    position_m: NDArray[np.float64]
    quaternion: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.image_paths)

    def select(self, indices: NDArray[np.int64]) -> Frames:
        """Return the frames at some indices, in that order."""
        return Frames(
            tuple(self.image_paths[i] for i in indices),
            tuple(self.sequences[i] for i in indices),
            self.position_m[indices],
            self.quaternion[indices],
        )

    def digest(self) -> str:
        """Say which frames these are: a hash of their names and poses, wherever they lie."""
        digest = hashlib.sha256()
        for path in self.image_paths:
            digest.update(f"{path.parent.name}/{path.name}\0".encode())
        digest.update(self.position_m.tobytes())
        digest.update(self.quaternion.tobytes())
        return digest.hexdigest()

    def rows_by_name(self, folder: Path) -> dict[str, int]:
        """Rows by the name that a model in the scene's folder knows the images by: :func:`plain_name` of their path."""
        return {plain_name(path.relative_to(folder).as_posix()): row for row, path in enumerate(self.image_paths)}

    @renamed_arguments(most="count")
    def evenly_spread(self, count: int) -> list[int]:
        """Indices of at most so many frames, evenly spread from the first to the last."""
        return np.linspace(0, len(self) - 1, min(count, len(self))).round().astype(int).tolist()

    def by_sequence(self) -> dict[str, NDArray[np.int64]]:
        """Indices of each sequence's frames, in order of first appearance."""
        names = np.array(self.sequences)
        return {name: np.flatnonzero(names == name) for name in dict.fromkeys(self.sequences)}


def plain_name(image: str) -> str:
    """An image's path without suffix: models are made of ``.jpg`` where the dataset ships ``.png``."""
    path = PurePosixPath(image.replace("\\", "/"))
    return str(path.parent / path.stem)


@dataclass(frozen=True)
class Cameras:
    """The pinhole camera of each of N frames.

    Shape:
        ``intrinsics`` (N, 3, 3) float64, in pixels of images of ``size_px`` (N, 2): width and height.

    Args:
        is_assumed: the scene does not give its cameras, and a usual one is assumed.
    """

    intrinsics: NDArray[np.float64]
    size_px: NDArray[np.int64]
    is_assumed: bool = False

    def describe(self) -> dict[str, Any]:
        """The median focal length over the width, and whether it is an assumption."""
        ratio = np.median(self.intrinsics[:, 0, 0] / self.size_px[:, 0])
        return {"focal_ratio": round(float(ratio), 4), "assumed": self.is_assumed}
