"""Cambridge Landmarks (Kendall et al. 2015) in its official on-disk layout.

``SCENE/dataset_train.txt`` and ``dataset_test.txt``: three header lines, then ``ImageFile X Y Z W P Q R``. XYZ is the
camera centre in the world; WPQR is **world-to-camera**, scalar first, so ``world_from_cam`` takes its conjugate.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np

from mambaloc.data.datasets.dataset import Archive, Dataset, Source
from mambaloc.data.frames import FARTHEST_M, UNIT_TOLERANCE, BadFrames, Frames, Rejection, Split
from mambaloc.errors import InputError
from mambaloc.runtime.rotations import canonical, conjugate
from mambaloc.text import decode_text

# Scene, frames to train and test on where the benchmark has it, and where its zip is in the university's repository.
# GreatCourt's and Street's REST addresses rest on a single public script.
_SCENES = (
    ("KingsCollege", (1220, 343), 251342, "1cd2b04b-ada9-4841-8023-8207f1f3519b"),
    ("OldHospital", (895, 182), 251340, "ae577bfb-bdce-488c-8ce6-3765eabe420e"),
    ("ShopFacade", (231, 103), 251336, "4e5c67dd-9497-4a1d-add4-fd0e00bcb8cb"),
    ("StMarysChurch", (1487, 530), 251294, "2559ba20-c4d1-4295-b77f-183f580dbc56"),
    ("GreatCourt", None, 251291, "bceda7ac-e51c-40ca-b9d7-d758d40cdcf4"),
    ("Street", None, 251292, "d39a7732-591f-470a-9f5e-2a9892118abd"),
)

OFFICIAL_COUNTS = {scene: counts for scene, counts, _, _ in _SCENES if counts}
"""Frames of the official train and test split of each scene of the benchmark."""

KNOWN_BAD_LABELS = {
    ("GreatCourt", "seq5/frame00297"),  # 3.1e9 m away
    ("ShopFacade", "seq2/frame00036"),  # jumps by metres and 150 degrees between neighbours
    ("ShopFacade", "seq2/frame00043"),
}

_SPLIT_FILES = {"train": "dataset_train.txt", "test": "dataset_test.txt"}
_HEADER_LINES = 3


def read_split(folder: Path, split: Split, bad: BadFrames) -> Frames:
    """Read the posed frames of one split of a scene's folder.

    Raises:
        InputError: for a missing split file or one without header or frames; and for a bad frame where ``bad`` says so.
    """
    split_file = folder / _SPLIT_FILES[split]
    images: list[PurePosixPath] = []
    numbers: list[list[float]] = []
    for row, words in _listed_frames(split_file):
        pose = _read_line(folder, Path(f"{split_file}, line {row}"), words)
        if isinstance(pose, Rejection):
            bad.reject(pose.path, pose.rule)
            continue
        images.append(PurePosixPath(words[0]))
        numbers.append(pose)
        if abs(float(np.linalg.norm(pose[3:])) - 1) > UNIT_TOLERANCE:
            bad.repair(folder / images[-1], "quaternion of another length than 1, normalised")
    if not images:
        raise InputError(f"{split_file}: has no usable frame after its three header lines")
    poses = np.array(numbers)
    sequences = tuple(str(image.parent) for image in images)
    quaternion = canonical(conjugate(poses[:, 3:]))
    return Frames(tuple(folder / image for image in images), sequences, poses[:, :3].copy(), quaternion)


def _listed_frames(split_file: Path) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each line after the header.

    Raises:
        InputError: for a missing file, or one without header.
    """
    if not split_file.is_file():
        raise InputError(f"{split_file}: missing; it lists the split's frames as lines 'ImageFile X Y Z W P Q R'")
    lines = decode_text(split_file.read_bytes()).splitlines()
    for row, line in enumerate(lines, start=1):
        words = line.split()
        if row > _HEADER_LINES and words:
            yield row, words
        elif row <= _HEADER_LINES and _is_frame(words):
            raise InputError(f"{split_file}, line {row}: is a frame; put three header lines before it")


def _listed_sequences(split_file: Path) -> list[str]:
    return sorted({str(PurePosixPath(words[0]).parent) for _, words in _listed_frames(split_file)})


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
    if not np.isfinite(numbers).all() or max(map(abs, numbers[:3])) > FARTHEST_M:
        return Rejection(place, f"has a position that is not finite or beyond {FARTHEST_M:g} m")
    if float(np.linalg.norm(numbers[3:])) < 0.5:
        return Rejection(place, "has a quaternion near zero")
    if not (folder / image).is_file():
        return Rejection(folder / image, "pose without image")
    return numbers


def _archive(scene: str, handle: int, bitstream: str) -> Archive:
    # The repository's REST address comes first: the older handle address redirects to it.
    return Archive(
        (
            f"https://api.repository.cam.ac.uk/server/api/core/bitstreams/{bitstream}/content",
            f"https://www.repository.cam.ac.uk/bitstream/handle/1810/{handle}/{scene}.zip",
        )
    )


# The addresses are those that public localization code downloads from; they were not tried from here. The university
# publishes neither size nor checksum that we know of; the licence is quoted from the record of King's College.
SOURCE = Source(
    name="cambridge",
    title="Cambridge Landmarks",
    page="http://mi.eng.cam.ac.uk/projects/relocalization/",
    licence="CC BY-NC-SA 2.0 UK",
    terms="non-commercial, credit the authors, share alike",
    splits=tuple(_SPLIT_FILES.values()),
    sequences=_listed_sequences,
    archives={scene: _archive(scene, handle, bitstream) for scene, _, handle, bitstream in _SCENES},
)

DATASET = Dataset(SOURCE.name, read_split, OFFICIAL_COUNTS, SOURCE.default_root, source=SOURCE)
