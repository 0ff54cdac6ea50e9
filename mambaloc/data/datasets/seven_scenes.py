"""7-Scenes (Shotton et al. 2013) in its official on-disk layout.

``SCENE/TrainSplit.txt`` and ``TestSplit.txt`` list ``sequenceN`` lines; ``SCENE/seq-NN/frame-NNNNNN`` has
``.color.png`` (official) or ``.color.jpg``, and ``.pose.txt``, a 4x4 camera-to-world matrix in metres.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.datasets.dataset import Archive, Dataset, Source
from mambaloc.data.frames import ROTATION_TOLERANCE, BadFrames, Frames, Split
from mambaloc.errors import InputError
from mambaloc.runtime.rotations import is_rotation, quaternion_from_matrix
from mambaloc.text import decode_text, natural

# Scene, frames to train and test on, bytes and sha256 of its zip. Sizes and checksums are one public project's pins of
# the files that it downloaded, not Microsoft's own figures; hence `accept_changed`.
_SCENES = (
    ("chess", 4000, 2000, 3079608937, "d00b5b8f904123ec136768ee0ebd8f72aebb5473630fb5d8ec352e70ae4859d0"),
    ("fire", 2000, 2000, 2301204154, "735d577f471a116b3f190f9bd79026b7fccfc6dee220473499bdb2b93efd1955"),
    ("heads", 1000, 1000, 956332240, "402f8760ba150100bda5360241b605383dc5f949c055863301bde1b45f6a7a5d"),
    ("office", 6000, 4000, 4707873861, "c2bd101aae86c926d43ed92e080140b2e32d54ce14a5ce289b9aeca3472e7744"),
    ("pumpkin", 4000, 2000, 2890874911, "53fd1cb4c2f50378abc112f48e8897138e2135f2848c8c2e094e8028af07a65f"),
    ("redkitchen", 7000, 5000, 6141181406, "55f6aeabfd8308fbe02a6f37d1dbdbc4c087c3c6c84cb5fae062a90c43ffcba6"),
    ("stairs", 2000, 1000, 1496412431, "3521a1a26acb98321918ec352f8b189d301c2e3cce2de1bf2eac424d003b3929"),
)

OFFICIAL_COUNTS = {scene: (train, test) for scene, train, test, _, _ in _SCENES}
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
        sequence = folder / _sequence_folder(number)
        if not sequence.is_dir():
            raise InputError(f"{folder / _SPLIT_FILES[split]}: lists sequence{number}, but there is no {sequence}")
        for image, matrix in _posed_images(sequence, bad):
            paths.append(image)
            sequences.append(sequence.name)
            matrices.append(matrix)
    if not paths:
        raise InputError(
            f"{folder / _SPLIT_FILES[split]}: its sequences have no usable frame. Check the sequence folders."
        )
    world_from_cam = np.stack(matrices)
    quaternion = quaternion_from_matrix(world_from_cam[:, :3, :3])
    return Frames(tuple(paths), tuple(sequences), world_from_cam[:, :3, 3].copy(), quaternion)


def _sequence_folder(number: int) -> str:
    return f"seq-{number:02d}"


def _listed_sequences(split_file: Path) -> list[int]:
    if not split_file.is_file():
        raise InputError(f"{split_file}: missing; it lists the split's sequences, a line 'sequenceN' each")
    numbers: dict[int, None] = {}  # in order, and found at once however many there are
    for row, line in enumerate(decode_text(split_file.read_bytes()).splitlines(), start=1):
        if not line.strip():
            continue
        match = re.fullmatch(r"\s*sequence\s*(\d{1,6})\s*", line, re.IGNORECASE)
        if not match:
            raise InputError(f"{split_file}, line {row}: {line.strip()[:40]!r} is not a 'sequenceN'; correct the line")
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
    for path in sorted(sequence.iterdir(), key=natural):
        stem, _, kind = path.name.partition(".")
        if kind in ("color.png", "color.jpg"):
            images.setdefault(stem, path)
        elif kind == "pose.txt":
            poses[stem] = path
    posed = []
    for stem in sorted(images.keys() | poses.keys(), key=lambda stem: natural(Path(stem))):
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
        lines = decode_text(path.read_bytes()).splitlines()
        rows = [[float(word) for word in line.split()] for line in lines if line.strip()]
    except (ValueError, OSError):
        return "pose is not a text of numbers"
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        return f"pose is not a 4x4 matrix but has rows of {[len(row) for row in rows][:6]}"
    matrix = np.array(rows)
    if not np.isfinite(matrix).all():
        return "pose has NaN or infinite numbers"
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        return "pose's last row is not 0 0 0 1"
    if not is_rotation(matrix[:3, :3], ROTATION_TOLERANCE):
        return "pose's rotation is not orthonormal"
    return matrix


def _archive(scene: str, size_bytes: int, sha256: str) -> Archive:
    folder = "download.microsoft.com/download/2/8/5/28564B23-0828-408F-8631-23B1EFF1DAC8"
    return Archive((f"https://{folder}/{scene}.zip", f"http://{folder}/{scene}.zip"), size_bytes, sha256)


# The addresses are those that public localization code downloads from; they were not tried from here. The exact licence
# text is on the project page only.
SOURCE = Source(
    name="7scenes",
    title="7-Scenes",
    page="https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
    licence="Microsoft 7-Scenes licence",
    terms="non-commercial research",
    splits=tuple(_SPLIT_FILES.values()),
    sequences=lambda split_file: [_sequence_folder(number) for number in _listed_sequences(split_file)],
    archives={scene: _archive(scene, size_bytes, sha256) for scene, _, _, size_bytes, sha256 in _SCENES},
)

DATASET = Dataset(SOURCE.name, read_split, OFFICIAL_COUNTS, SOURCE.default_root, source=SOURCE)
