"""``transforms.json`` of nerfstudio and instant-ngp, and NeRF's ``transforms_train.json`` with its companions.

Each frame has a camera-to-world matrix in OpenGL's camera axes: x right, y up, z back. Its numbers come in rows or in
one list, and column after column where only that gives rotations, as WebGL and ARKit have them. ScanNet++ has
``test_frames`` beside ``frames``, and marks frames that are blurred or in shadow ``is_bad``
(github.com/scannetpp/scannetpp).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mambaloc.data.frames import ROTATION_TOLERANCE
from mambaloc.errors import InputError
from mambaloc.importing.capture import OPENCV_FROM_OPENGL, Capture
from mambaloc.importing.formats.builder import Matrices, Pose, Posed, build_capture, validate_se3
from mambaloc.importing.formats.finding import find_images
from mambaloc.importing.formats.listed_splits import given_split
from mambaloc.importing.formats.nerfstudio_cameras import KEYS, number, read_cameras
from mambaloc.importing.formats.parsing import images_in_same_folders, read_object
from mambaloc.importing.formats.pose_rows import is_by_column, matrices_of
from mambaloc.runtime.rotations import is_rotation
from mambaloc.text import natural

FILES: Mapping[str, str | None] = {
    "transforms.json": None,
    "transforms_train.json": "train",
    "transforms_val.json": "val",
    "transforms_test.json": "test",
}
"""Names of the file, the one that holds all frames first, and the split that its frames are of."""

_LISTS = tuple(f"{split}_filenames" for split in ("train", "val", "test"))
_READ = {"frames", "test_frames", "applied_transform", "applied_scale", *_LISTS, *KEYS}
_READ_OF_FRAMES = {"file_path", "transform_matrix", "is_bad", *KEYS}
_NAMED = 12  # keys that are not read
_LOOKED_AT = 200  # matrices
_BAD = "marked is_bad by the capture"


@dataclass(frozen=True)
class _Frame:
    """A frame of a file; ``split`` where the file's lists give it; ``fault`` of its matrix."""

    where: str
    name: Any
    world_from_cam: Matrices
    intrinsics: dict[str, Any]
    split: str | None
    is_bad: bool
    fault: str


def matches(source: Path) -> bool:
    """Whether a source holds such a file, or is one."""
    return source.name in FILES if source.is_file() else any((source / name).is_file() for name in FILES)


def read(source: Path, images: Path | None = None) -> Capture:
    """Read a folder of such files, or a single file.

    A pose that is not finite or no rotation is kept: the checks name its frame and leave it out.

    Args:
        source: the folder, or the file.
        images: the folder of the images that the file names; the file's own unless given.

    Raises:
        InputError: for a file that is malformed, or names an image that is nowhere in the folder or twice, or a camera
            that cannot be one; and where none of its images is there.
    """
    files = [source] if source.is_file() else [source / name for name in FILES if (source / name).is_file()]
    if not files:
        raise InputError(f"{source}: contains none of {', '.join(FILES)}; give a folder that does")
    contents = {file: _content(file) for file in (files[:1] if files[0].name == "transforms.json" else files)}
    frames = [frame for file, content in contents.items() for frame in _frames(file, content)]
    if all(frame.fault for frame in frames):
        raise InputError(f"{frames[0].fault}; correct it")
    frames, exact = _with_exact_rotations(frames)
    given = given_split([frame.name for frame in frames], _lists(contents))
    folder = files[0].parent if images is None else images
    found = find_images(folder, [(frame.name, f"{frame.where}: file_path") for frame in frames])
    if given.split:
        frames = [
            replace(frame, split=given.split.get(row) or frame.split or "unused") for row, frame in enumerate(frames)
        ]
    pairs = sorted(zip(found.files, frames, strict=True), key=lambda pair: (natural(pair[0].parent), natural(pair[0])))
    there = [(image, frame) for image, frame in pairs if image not in found.missing]
    good = [(image, frame) for image, frame in there if not frame.is_bad]
    cameras, names, decided = read_cameras(
        [frame.intrinsics for _, frame in good], [image for image, _ in good], files[0]
    )
    posed = [
        Posed(image, _sequence(image, folder), Pose(frame.world_from_cam, frame.fault), name, split=frame.split)
        for (image, frame), name in zip(good, names, strict=True)
    ]
    choices = _choices(files[0].name, contents[files[0]], [file.name for file in files if file not in contents])
    return build_capture(
        "nerfstudio",
        files[0],
        posed,
        unit="unknown",
        choices={**choices, "cameras": decided, **given.choices, **found.choices, **exact},
        cameras=cameras,
        missing=[image.relative_to(folder).as_posix() for image, _ in pairs if image in found.missing],
        beside=images_in_same_folders(image for image, _ in pairs),
        split_concern=given.concern,
        left_out={image: _BAD for image, frame in there if frame.is_bad},
    )


def _content(file: Path) -> dict[str, Any]:
    content = read_object(file, "'frames' of nerfstudio or instant-ngp")
    for key in ("frames", "test_frames"):
        frames = content.get(key, [] if key == "test_frames" else None)
        if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise InputError(f"{file}: has no list of '{key}'; give a transforms.json of nerfstudio or instant-ngp")
    if not content["frames"]:
        raise InputError(f"{file}: has no list of 'frames'; give a transforms.json of nerfstudio or instant-ngp")
    return content


def _frames(file: Path, content: dict[str, Any]) -> Iterator[_Frame]:
    """Each frame with its intrinsics: its own, and the file's where it has none."""
    original_from_file, scale = _original_from_file(file, content)
    by_column = _is_by_column(content)
    shared = {key: content[key] for key in KEYS if key in content}
    test = content.get("test_frames") or []
    for count, frame in enumerate(_all_frames(content), start=1):
        is_test = count > len(content["frames"])
        where = f"{file}, test frame {count - len(content['frames'])}" if is_test else f"{file}, frame {count}"
        rows = frame.get("transform_matrix")
        world_from_cam, fault = np.full((4, 4), np.nan), ""  # a tracker's frame without a pose
        try:
            if rows is not None:
                world_from_cam = _matrix(rows, f"{where}: transform_matrix", by_column) @ OPENCV_FROM_OPENGL
        except ValueError as error:
            fault = str(error)
        world_from_cam[:3, 3] /= scale
        yield _Frame(
            where,
            frame.get("file_path"),
            original_from_file @ world_from_cam,
            {**shared, **{key: frame[key] for key in KEYS if key in frame}},
            FILES.get(file.name) or ("test" if is_test else "train" if test else None),
            frame.get("is_bad") in (True, "true", "True"),
            fault,
        )


def _with_exact_rotations(frames: list[_Frame]) -> tuple[list[_Frame], Mapping[str, str]]:
    """Frames whose rotations are exact where they were rounded, and what was decided; the checks leave out others."""
    poses = np.array([frame.world_from_cam for frame in frames])
    rows = np.flatnonzero(is_rotation(poses[:, :3, :3], ROTATION_TOLERANCE))
    if not len(rows):
        return frames, {}
    checked = validate_se3(poses[rows], lambda row: frames[rows[row]].where)
    poses[rows] = checked.poses
    return [replace(frame, world_from_cam=pose) for frame, pose in zip(frames, poses, strict=True)], checked.choices


def _lists(contents: Mapping[Path, dict[str, Any]]) -> dict[str, list[str]]:
    """The names in ``train_filenames`` and its like, by split."""
    lists: dict[str, list[str]] = {}
    for file, content in contents.items():
        for key in _LISTS:
            names = content.get(key) or []
            if not isinstance(names, list):
                raise InputError(f"{file}: {key} is not a list; correct it, or remove it")
            lists.setdefault(key.removesuffix("_filenames"), []).extend(map(str, names))
    return lists


def _sequence(image: Path, folder: Path) -> str:
    parent = image.parent.relative_to(folder)
    return parent.as_posix() if parent.name else "images"


def _original_from_file(file: Path, content: dict[str, Any]) -> tuple[Matrices, float]:
    """What takes the file's poses back to the world that they were made in, once positions are divided by a scale."""
    scale = number(content, "applied_scale", str(file))
    if scale is not None and not 1e-9 < scale < 1e9:
        raise InputError(f"{file}: applied_scale is {scale}; correct it, or remove it")
    if content.get("applied_transform") is None:
        return np.eye(4), scale or 1.0
    try:
        applied = _matrix(content["applied_transform"], f"{file}: applied_transform")
    except ValueError as error:
        raise InputError(f"{error}; correct it, or remove it") from None
    if not is_rotation(applied[:3, :3]) or not np.isfinite(applied).all():
        raise InputError(f"{file}: applied_transform is not a rotation and translation; correct it, or remove it")
    return np.linalg.inv(applied).astype(np.float64), scale or 1.0


def _choices(file: str, content: dict[str, Any], other_files: Sequence[str]) -> dict[str, str]:
    undone = [name for name in ("applied_transform", "applied_scale") if content.get(name) is not None]
    world = f"{' and '.join(undone)} undone: that of the data which {file} was made of"
    choices = {
        "axes": "OpenGL's (x right, y up, z back), turned to OpenCV's: the cameras' y and z axes are negated",
        "direction": f"camera to world, as {file} has it",
        **_how_written(content),
        "world": world if undone else f"that of {file}",
        "scale": "the format does not state its unit",
        "order": "by file name, its numbers as numbers, since the format has no times; a folder is a sequence",
    }
    of_frames = {key for frame in _all_frames(content) for key in frame}
    unread = [
        *other_files,
        *sorted(content.keys() - _READ),
        *(f"{k} of frames" for k in sorted(of_frames - _READ_OF_FRAMES)),
    ]
    if unread:
        choices["not read"] = ", ".join(name[:40] for name in unread[:_NAMED]) + (", ..." if unread[_NAMED:] else "")
    return choices


def _all_frames(content: dict[str, Any]) -> list[dict[str, Any]]:
    return [*content["frames"], *(content.get("test_frames") or [])]


def _is_by_column(content: dict[str, Any]) -> bool:
    """Whether the matrices are rotations and shifts only if they are written column after column."""
    frames = _all_frames(content)
    some = (_numbers(frame.get("transform_matrix")) for frame in frames[:: 1 + len(frames) // _LOOKED_AT])
    matrices = [each for each in some if each is not None]
    usual = [each for each in matrices if len(each) == max(map(len, matrices))]
    return bool(usual) and is_by_column(np.array(usual)) is True


def _how_written(content: dict[str, Any]) -> dict[str, str]:
    """What was decided of matrices that are not written in rows."""
    matrices = (frame.get("transform_matrix") for frame in _all_frames(content))
    in_one_list = sum(isinstance(each, list) and len(each) in (12, 16) for each in matrices)
    notes = [f"{in_one_list} in one list of numbers"] if in_one_list else []
    notes += ["written column after column: only so are they rotations"] if _is_by_column(content) else []
    return {"matrices": "; ".join(notes)} if notes else {}


def _numbers(matrix: Any) -> Matrices | None:
    """The 16 or 12 numbers of a 4x4 or 3x4 matrix, in rows or in one list; None where it is anything else."""
    try:
        numbers = np.array([[float(each) for each in row] if isinstance(row, list) else float(row) for row in matrix])
    except (ValueError, TypeError, OverflowError):
        return None
    return numbers.ravel() if numbers.shape in ((4, 4), (3, 4), (16,), (12,)) else None


def _matrix(value: Any, where: str, by_column: bool = False) -> Matrices:
    """A matrix as (4, 4); NaN and infinity are kept.

    Raises:
        ValueError: for anything else than a 4x4 or 3x4 matrix.
    """
    numbers = _numbers(value)
    if numbers is None:
        raise ValueError(f"{where} is not a 4x4 or 3x4 matrix of numbers")
    (matrix,) = matrices_of(numbers[None], by_column)
    if np.isfinite(matrix[3:]).all() and not np.allclose(matrix[3:], (0, 0, 0, 1), atol=1e-6):
        raise ValueError(f"{where}'s last row is not 0 0 0 1")
    return np.concatenate((matrix[:3], [[0.0, 0.0, 0.0, 1.0]]))
