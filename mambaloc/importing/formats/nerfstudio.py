"""``transforms.json`` of nerfstudio and instant-ngp, and NeRF's ``transforms_train.json`` with its companions.

Each frame has a camera-to-world matrix in OpenGL's camera axes: x right, y up, z back.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import PICTURES
from mambaloc.importing.capture import OPENCV_FROM_OPENGL, Capture
from mambaloc.importing.formats.builder import Matrices, Posed, build_capture
from mambaloc.importing.formats.nerfstudio_cameras import KEYS, number, read_cameras
from mambaloc.importing.formats.parsing import inside, pictures_beside, read_object
from mambaloc.runtime.rotations import is_rotation
from mambaloc.text import natural

FILES: Mapping[str, str | None] = {
    "transforms.json": None,
    "transforms_train.json": "train",
    "transforms_val.json": "val",
    "transforms_test.json": "test",
}
"""Names of the file, the one that holds all frames first, and the split that its frames are of."""


def matches(source: Path) -> bool:
    """Whether a source holds such a file, or is one."""
    return source.name in FILES if source.is_file() else any((source / name).is_file() for name in FILES)


def read(source: Path) -> Capture:
    """Read a folder that holds such files, or one of them.

    A pose that is not finite or no rotation is kept: the checks name its frame and leave it out.

    Raises:
        InputError: for a file that is malformed, or names an image outside of its folder or twice, or a camera that
            cannot be one; and where none of its images is there.
    """
    files = [source] if source.is_file() else [source / name for name in FILES if (source / name).is_file()]
    if not files:
        raise InputError(f"{source}: holds none of {', '.join(FILES)}; give a folder that does")
    if files[0].name == "transforms.json":
        del files[1:]
    contents = {file: _content(file) for file in files}
    frames = [frame for file, content in contents.items() for frame in _frames(file, content)]
    frames.sort(key=lambda frame: (natural(frame[0].image.parent), natural(frame[0].image)))
    present = [frame for frame in frames if frame[0].image.is_file()]
    images, folder = [posed.image for posed, _ in frames], files[0].parent
    cameras, names, decided = read_cameras(
        [intrinsics for _, intrinsics in present], [posed.image for posed, _ in present], files[0]
    )
    return build_capture(
        "nerfstudio",
        files[0],
        [replace(posed, camera=name) for (posed, _), name in zip(present, names, strict=True)],
        unit="unknown",
        choices={**_choices(files[0].name, contents[files[0]]), "cameras": decided},
        cameras=cameras,
        missing=[image.relative_to(folder).as_posix() for image in images if not image.is_file()],
        beside=pictures_beside(images),
    )


def _content(file: Path) -> dict[str, Any]:
    content = read_object(file, "'frames' of nerfstudio or instant-ngp")
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{file}: has no list of 'frames'; give a transforms.json of nerfstudio or instant-ngp")
    return content


def _frames(file: Path, content: dict[str, Any]) -> Iterator[tuple[Posed, dict[str, Any]]]:
    """Each frame with its intrinsics: its own, and the file's where it has none."""
    original_from_file, scale = _original_from_file(file, content)
    shared = {key: content[key] for key in KEYS if key in content}
    splits = _named_splits(file, content)
    for count, frame in enumerate(content["frames"], start=1):
        where = f"{file}, frame {count}"
        image = _image(file, frame.get("file_path"), f"{where}: file_path")
        world_from_cam = _matrix(frame.get("transform_matrix"), f"{where}: transform_matrix") @ OPENCV_FROM_OPENGL
        world_from_cam[:3, 3] /= scale
        folder = image.parent.relative_to(file.parent)
        sequence = folder.as_posix() if folder.name else "images"
        split = FILES.get(file.name) or (splits.get(image, "unused") if splits else None)
        posed = Posed(image, sequence, original_from_file @ world_from_cam, split=split)
        yield posed, {**shared, **{key: frame[key] for key in KEYS if key in frame}}


def _original_from_file(file: Path, content: dict[str, Any]) -> tuple[Matrices, float]:
    """What takes the file's poses back to the world that they were made in, once positions are divided by a scale."""
    scale = number(content, "applied_scale", str(file))
    if scale is not None and not 1e-9 < scale < 1e9:
        raise InputError(f"{file}: applied_scale is {scale}; correct it, or remove it")
    if content.get("applied_transform") is None:
        return np.eye(4), scale or 1.0
    applied = _matrix(content["applied_transform"], f"{file}: applied_transform")
    if not is_rotation(applied[:3, :3]) or not np.isfinite(applied).all():
        raise InputError(f"{file}: applied_transform is no rotation and shift; correct it, or remove it")
    return np.linalg.inv(applied).astype(np.float64), scale or 1.0


def _choices(file: str, content: dict[str, Any]) -> dict[str, str]:
    undone = [name for name in ("applied_transform", "applied_scale") if content.get(name) is not None]
    world = f"{' and '.join(undone)} undone: that of the data which {file} was made of"
    return {
        "axes": "OpenGL's (x right, y up, z back), turned to OpenCV's: the cameras' y and z axes are negated",
        "direction": f"camera to world, as {file} has it",
        "world": world if undone else f"that of {file}",
        "scale": "the format does not tell its unit",
        "order": "by file name, its numbers as numbers, since the format tells no time; a folder is a sequence",
    }


def _named_splits(file: Path, content: dict[str, Any]) -> dict[Path, str]:
    """The split of each image of ``train_filenames`` and its like."""
    splits: dict[Path, str] = {}
    for split in ("train", "val", "test"):
        key = f"{split}_filenames"
        names = content.get(key) or []
        if not isinstance(names, list):
            raise InputError(f"{file}: {key} is no list; correct it, or remove it")
        splits |= {_image(file, name, f"{file}: {key}"): split for name in names}
    return splits


def _image(file: Path, name: Any, where: str) -> Path:
    """The image that a file names, with its suffix or without."""
    path = inside(file.parent, name, where)
    if path.suffix.lower() in PICTURES:
        return path
    stem = path.relative_to(file.parent).as_posix()
    named = (inside(file.parent, stem + suffix, where) for suffix in (*PICTURES, *map(str.upper, PICTURES)))
    return next((image for image in named if image.is_file()), path)


def _matrix(rows: Any, where: str) -> Matrices:
    """A 4x4 or 3x4 matrix as (4, 4); NaN and infinity are kept."""
    try:
        matrix = np.array([[float(each) for each in row] for row in rows])
    except (ValueError, TypeError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"{where} is no 4x4 or 3x4 matrix of numbers; correct it")
    if np.isfinite(matrix[3:]).all() and not np.allclose(matrix[3:], (0, 0, 0, 1), atol=1e-6):
        raise InputError(f"{where}'s last row is not 0 0 0 1; correct it")
    return np.concatenate((matrix[:3], [[0.0, 0.0, 0.0, 1.0]]))
