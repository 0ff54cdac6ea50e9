"""``transforms.json`` of nerfstudio and instant-ngp, and NeRF's ``transforms_train.json`` with its companions.

Each frame has a camera-to-world matrix in OpenGL's camera axes: x right, y up, z back.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.datasets.capture import MOST_FRAMES
from mambaloc.errors import InputError
from mambaloc.files import path_inside, read_json
from mambaloc.images import PICTURES
from mambaloc.importing.capture import OPENCV_FROM_OPENGL, Capture
from mambaloc.importing.formats.nerfstudio_cameras import KEYS, number, read_cameras
from mambaloc.importing.formats.parsing import natural

FILES: Mapping[str, str | None] = {
    "transforms.json": None,
    "transforms_train.json": "train",
    "transforms_val.json": "val",
    "transforms_test.json": "test",
}
"""Names of the file, the one that holds all frames first, and the split that its frames are of."""


@dataclass(frozen=True)
class _Listed:
    """A frame as a file lists it; ``intrinsics`` hold the file's values where the frame has none of its own."""

    name: str
    image: Path
    world_from_cam: NDArray[np.float64]
    intrinsics: Mapping[str, Any]
    split: str | None

    @property
    def sequence(self) -> str:
        return self.name.rpartition("/")[0] or "images"


def matches(source: Path) -> bool:
    """Whether a source holds such a file, or is one."""
    return source.name in FILES if source.is_file() else any((source / name).is_file() for name in FILES)


def read(source: Path) -> Capture:
    """Read a folder that holds such files, or one of them.

    Raises:
        InputError: for a file that is malformed, names an image outside of its folder or twice, or a camera that is
            none; and where no image is there.
    """
    files = [source] if source.is_file() else [source / name for name in FILES if (source / name).is_file()]
    if not files:
        raise InputError(f"{source}: holds none of {', '.join(FILES)}; give a folder that does")
    if files[0].name == "transforms.json":
        del files[1:]
    told = {file: _read(file) for file in files}
    listed = [frame for file, content in told.items() for frame in _frames(file, content)]
    listed.sort(key=lambda frame: (natural(Path(frame.sequence)), natural(Path(frame.name))))
    if twice := next((a.name for a, b in pairwise(listed) if a.name == b.name), None):
        raise InputError(f"{source}: lists {twice} twice; remove one of the two")
    present = [frame for frame in listed if frame.image.is_file()]
    if not present:
        raise InputError(f"{files[0]}: none of its {len(listed)} images is there, as {listed[0].image}; add them")
    cameras, camera_of, said = read_cameras(
        [frame.intrinsics for frame in present], [frame.image for frame in present], files[0]
    )
    splits = [frame.split for frame in present]
    return Capture(
        kind="nerfstudio",
        images=tuple(frame.image for frame in present),
        sequences=tuple(frame.sequence for frame in present),
        world_from_cam=np.stack([frame.world_from_cam for frame in present]),
        unit="unknown",
        choices={**_choices(files[0], told[files[0]]), "cameras": said},
        cameras=cameras,
        camera_of=camera_of,
        split=tuple(split or "unused" for split in splits) if any(splits) else None,
        poses_without_image=tuple(frame.name for frame in listed if not frame.image.is_file()),
        images_without_pose=_beside([frame.image for frame in listed]),
    )


def _read(file: Path) -> dict[str, Any]:
    content = read_json(file, "give one that can be", "export it again")
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{file}: has no list of 'frames'; give a transforms.json of nerfstudio or instant-ngp")
    if len(frames) > MOST_FRAMES:
        raise InputError(f"{file}: lists {len(frames)} frames, more than {MOST_FRAMES}; keep fewer")
    return content


def _frames(file: Path, content: dict[str, Any]) -> Iterator[_Listed]:
    original_from_file, scale = _undoing(file, content)
    shared = {key: content[key] for key in KEYS if key in content}
    splits = _named_splits(file, content)
    for count, frame in enumerate(content["frames"], start=1):
        where = f"{file}, frame {count}"
        image = _image(file, frame.get("file_path"), f"{where}: file_path")
        name = image.relative_to(file.parent).as_posix()
        world_from_cam = _matrix(frame.get("transform_matrix"), f"{where}: transform_matrix") @ OPENCV_FROM_OPENGL
        world_from_cam[:3, 3] /= scale
        own = {key: frame[key] for key in KEYS if key in frame}
        split = FILES[file.name] if FILES.get(file.name) else splits.get(name)
        yield _Listed(name, image, original_from_file @ world_from_cam, {**shared, **own}, split)


def _undoing(file: Path, content: dict[str, Any]) -> tuple[NDArray[np.float64], float]:
    """What brings the file's poses back to the world that they were made in, once their positions are unscaled."""
    scale = number(content, "applied_scale", str(file))
    if scale is not None and not 1e-9 < scale < 1e9:
        raise InputError(f"{file}: applied_scale is {scale}; correct it, or remove it")
    applied = np.eye(4)
    if content.get("applied_transform") is not None:
        applied = _matrix(content["applied_transform"], f"{file}: applied_transform")
    rotation = applied[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise InputError(f"{file}: applied_transform is no rotation and shift; correct it, or remove it")
    return np.linalg.inv(applied).astype(np.float64), 1.0 if scale is None else scale


def _choices(file: Path, content: dict[str, Any]) -> dict[str, str]:
    undone = [name for name in ("applied_transform", "applied_scale") if content.get(name) is not None]
    world = f"{' and '.join(undone)} undone: that of the data which {file.name} was made of"
    return {
        "axes": "OpenGL's (x right, y up, z back), turned to OpenCV's: the cameras' y and z axes are negated",
        "direction": f"camera to world, as {file.name} has it",
        "world": world if undone else f"that of {file.name}",
        "scale": "the format does not tell its unit",
        "order": "by file name, its numbers as numbers, since the format tells no time; a folder is a sequence",
    }


def _named_splits(file: Path, content: dict[str, Any]) -> dict[str, str]:
    """Splits by an image's name, where ``train_filenames`` and its like tell them."""
    found: dict[str, str] = {}
    for split in ("train", "val", "test"):
        key = f"{split}_filenames"
        names = content.get(key) or []
        if not isinstance(names, list):
            raise InputError(f"{file}: {key} is no list; correct it, or remove it")
        found |= {_image(file, name, f"{file}: {key}").relative_to(file.parent).as_posix(): split for name in names}
    return found


def _image(file: Path, name: Any, where: str) -> Path:
    """Find the image that a file names, with a suffix or without."""
    path = path_inside(file.parent, name) if isinstance(name, str) else None
    if path is None:
        raise InputError(f"{where}: {str(name)[:80]!r} is no path inside of {file.parent}; correct it")
    if path.suffix.lower() in PICTURES:
        return path
    named = [path.with_name(path.name + suffix) for suffix in (*PICTURES, *(s.upper() for s in PICTURES))]
    return next((each for each in named if each.is_file()), path)


def _matrix(told: Any, where: str) -> NDArray[np.float64]:
    """A 4x4 or 3x4 matrix; NaN stays, and is left out with its frame."""
    try:
        matrix = np.array([[float(each) for each in row] for row in told])
    except (ValueError, TypeError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"{where} is no 4x4 or 3x4 matrix of numbers; correct it")
    if np.isfinite(matrix[3:]).all() and not np.allclose(matrix[3:], (0, 0, 0, 1), atol=1e-6):
        raise InputError(f"{where}'s last row is not 0 0 0 1; correct it")
    return np.concatenate((matrix[:3], [[0.0, 0.0, 0.0, 1.0]]))


def _beside(images: Sequence[Path]) -> tuple[Path, ...]:
    """Pictures in the folders of listed images that are not listed."""
    listed = set(images)
    folders = [folder for folder in dict.fromkeys(image.parent for image in images) if folder.is_dir()]
    pictures = [path for folder in folders for path in sorted(folder.iterdir()) if path.suffix.lower() in PICTURES]
    return tuple(path for path in pictures if path not in listed)
