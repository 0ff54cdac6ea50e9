"""7-Scenes (Shotton et al. 2013) in its official on-disk layout.

``SCENE/TrainSplit.txt`` and ``TestSplit.txt`` list ``sequenceN`` lines; ``SCENE/seq-NN/frame-NNNNNN`` has
``.color.png`` (official) or ``.color.jpg``, and ``.pose.txt``, a 4x4 camera-to-world matrix in metres.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mambaloc.data.frames import BadFrames, Frames, Split
from mambaloc.errors import InputError
from mambaloc.geometry import is_rotation, quaternion_from_matrix

OFFICIAL_COUNTS: dict[str, tuple[int, int]] = {
    "chess": (4000, 2000),
    "fire": (2000, 2000),
    "heads": (1000, 1000),
    "office": (6000, 4000),
    "pumpkin": (4000, 2000),
    "redkitchen": (7000, 5000),
    "stairs": (2000, 1000),
}
"""Frames of the official train and test split of each scene."""

_SPLIT_FILES = {"train": "TrainSplit.txt", "test": "TestSplit.txt"}


def read_split(folder: Path, split: Split, bad: BadFrames) -> Frames:
    """Read the posed frames of one split of a scene's folder.

    Raises:
        InputError: for a missing or empty split file, an unknown sequence, or no frame at all; and for a bad frame
            where ``bad`` says so.
    """
    paths: list[Path] = []
    sequences: list[str] = []
    matrices: list[NDArray[np.float64]] = []
    for number in _listed_sequences(folder / _SPLIT_FILES[split]):
        sequence = folder / f"seq-{number:02d}"
        if not sequence.is_dir():
            raise InputError(f"{folder / _SPLIT_FILES[split]}: lists sequence{number}, but there is no {sequence}")
        for image, matrix in _posed_images(sequence, bad):
            paths.append(image)
            sequences.append(sequence.name)
            matrices.append(matrix)
    if not paths:
        raise InputError(f"{folder / _SPLIT_FILES[split]}: its sequences hold no usable frame")
    world_from_cam = np.stack(matrices)
    quaternion = quaternion_from_matrix(torch.from_numpy(world_from_cam[:, :3, :3])).numpy()
    return Frames(tuple(paths), tuple(sequences), world_from_cam[:, :3, 3].copy(), quaternion)


def _listed_sequences(split_file: Path) -> list[int]:
    if not split_file.is_file():
        raise InputError(f"{split_file}: missing; it lists the split's sequences, a line 'sequenceN' each")
    numbers: dict[int, None] = {}  # in order, and found at once however many there are
    for row, line in enumerate(split_file.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        if not line.strip():
            continue
        match = re.fullmatch(r"\s*sequence\s*(\d{1,6})\s*", line, re.IGNORECASE)
        if not match:
            raise InputError(f"{split_file}, line {row}: {line.strip()[:40]!r} is no 'sequenceN'; correct the line")
        if int(match[1]) in numbers:
            raise InputError(f"{split_file}, line {row}: lists sequence{int(match[1])} again; remove the line")
        numbers[int(match[1])] = None
    if not numbers:
        raise InputError(f"{split_file}: lists no sequence; add lines 'sequence1', 'sequence2', ...")
    return list(numbers)


def _posed_images(sequence: Path, bad: BadFrames) -> list[tuple[Path, NDArray[np.float64]]]:
    """Pair the images of a sequence with their matrices."""
    images: dict[str, Path] = {}
    poses: dict[str, Path] = {}
    for path in sorted(sequence.iterdir()):
        stem, _, kind = path.name.partition(".")
        if kind in ("color.png", "color.jpg"):
            images.setdefault(stem, path)
        elif kind == "pose.txt":
            poses[stem] = path
    posed = []
    for stem in sorted(images.keys() | poses.keys()):
        if stem not in poses:
            bad.reject(images[stem], "image without pose")
        elif stem not in images:
            bad.reject(poses[stem], "pose without image")
        elif isinstance(matrix := _read_matrix(poses[stem]), str):
            bad.reject(poses[stem], matrix)
        else:
            posed.append((images[stem], matrix))
    return posed


def _read_matrix(path: Path) -> NDArray[np.float64] | str:
    """Read a 4x4 camera-to-world matrix, or return the rule it breaks."""
    try:
        rows = [[float(word) for word in line.split()] for line in path.read_text().splitlines() if line.strip()]
    except (ValueError, OSError):  # UnicodeDecodeError is a ValueError
        return "pose is not a text of numbers"
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        return f"pose is not a 4x4 matrix but has rows of {[len(row) for row in rows][:6]}"
    matrix = np.array(rows)
    if not np.isfinite(matrix).all():
        return "pose has NaN or infinite numbers"
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        return "pose's last row is not 0 0 0 1"
    if not is_rotation(torch.from_numpy(matrix[:3, :3]), tolerance=1e-2):
        return "pose's rotation is not orthonormal"
    return matrix
