"""Cambridge Landmarks (Kendall et al. 2015) in its official on-disk layout.

``SCENE/dataset_train.txt`` and ``dataset_test.txt``: three header lines, then ``ImageFile X Y Z W P Q R``. XYZ is the
camera centre in the world; WPQR is **world-to-camera**, scalar first, so ``world_from_cam`` takes its conjugate.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
import torch

from mambaloc.data.frames import BadFrames, Frames, Rejection, Split
from mambaloc.errors import InputError
from mambaloc.geometry import canonical, conjugate

OFFICIAL_COUNTS: dict[str, tuple[int, int]] = {
    "KingsCollege": (1220, 343),
    "OldHospital": (895, 182),
    "ShopFacade": (231, 103),
    "StMarysChurch": (1487, 530),
}
"""Frames of the official train and test split of each scene of the benchmark."""

KNOWN_BAD_LABELS = {
    ("GreatCourt", "seq5/frame00297"),  # 3.1e9 m away
    ("ShopFacade", "seq2/frame00036"),  # jumps by metres and 150 degrees between neighbours
    ("ShopFacade", "seq2/frame00043"),
}

_SPLIT_FILES = {"train": "dataset_train.txt", "test": "dataset_test.txt"}
_HEADER_LINES = 3
_FARTHEST_M = 1e5
_UNIT_TOLERANCE = 1e-3


def read_split(folder: Path, split: Split, bad: BadFrames) -> Frames:
    """Read the posed frames of one split of a scene's folder.

    Raises:
        InputError: for a missing split file or one without header or frames; and for a bad frame where ``bad`` says so.
    """
    split_file = folder / _SPLIT_FILES[split]
    if not split_file.is_file():
        raise InputError(f"{split_file}: missing; it lists the split's frames as lines 'ImageFile X Y Z W P Q R'")
    lines = split_file.read_text(encoding="utf-8", errors="replace").splitlines()
    images: list[PurePosixPath] = []
    numbers: list[list[float]] = []
    for row, line in enumerate(lines[:_HEADER_LINES], start=1):
        if _is_frame(line.split()):
            raise InputError(f"{split_file}, line {row}: is a frame; put three header lines before it")
    for row, line in enumerate(lines[_HEADER_LINES:], start=_HEADER_LINES + 1):
        if not line.strip():
            continue
        pose = _read_line(folder, Path(f"{split_file}, line {row}"), line.split())
        if isinstance(pose, Rejection):
            bad.reject(pose.path, pose.rule)
            continue
        images.append(PurePosixPath(line.split()[0]))
        numbers.append(pose)
        if abs(float(np.linalg.norm(pose[3:])) - 1) > _UNIT_TOLERANCE:
            bad.repair(folder / images[-1], "quaternion of another length than 1, normalised")
    if not images:
        raise InputError(f"{split_file}: has no usable frame after its three header lines")
    poses = np.array(numbers)
    quaternion = canonical(conjugate(torch.from_numpy(poses[:, 3:]))).numpy()
    sequences = tuple(str(image.parent) for image in images)
    return Frames(tuple(folder / image for image in images), sequences, poses[:, :3].copy(), quaternion)


def _is_frame(words: list[str]) -> bool:
    try:
        return len([float(word) for word in words[1:]]) == 7
    except ValueError:
        return False


def _read_line(folder: Path, place: Path, words: list[str]) -> list[float] | Rejection:
    """Read the seven numbers of a line, or return the rule it breaks."""
    try:
        numbers = [float(word) for word in words[1:]]
    except ValueError:
        return Rejection(place, "is not an image and seven numbers")
    if len(numbers) != 7:
        return Rejection(place, f"has {len(numbers)} numbers instead of seven after the image")
    image = PurePosixPath(words[0])
    if image.is_absolute() or ".." in image.parts or not image.name:
        return Rejection(place, "names an image outside the scene's folder")
    if (folder.name, str(image.with_suffix(""))) in KNOWN_BAD_LABELS:
        return Rejection(folder / image, "is a known bad label of the dataset")
    if not np.isfinite(numbers).all() or max(map(abs, numbers[:3])) > _FARTHEST_M:
        return Rejection(place, f"has a position that is not finite or beyond {_FARTHEST_M:g} m")
    if float(np.linalg.norm(numbers[3:])) < 0.5:
        return Rejection(place, "has a quaternion near zero")
    if not (folder / image).is_file():
        return Rejection(folder / image, "pose without image")
    return numbers
