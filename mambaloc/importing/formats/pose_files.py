"""A file of its own for each image's pose: beside the image, or in a folder beside the images' folder.

``frame-000012.color.png`` with ``frame-000012.pose.txt`` is the layout of 7-Scenes (Shotton et al. 2013), of 12-Scenes
and of 3RScan: a 4x4 camera-to-world matrix in metres. ``X.jpg`` with ``X.txt``, ``X.pose.txt`` or ``X.npy``, and
``rgb/X.png`` with ``poses/X.txt`` (DSAC*, Brachmann and Rother 2021; Wayspots), are read the same way, in an unknown
unit: 4x4 or 3x4, row after row, or column after column where only that gives rotations.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mambaloc.data.depth_frames import INTRINSICS_FILE, depth_path, read_depth_intrinsics, read_depth_mm
from mambaloc.errors import InputError
from mambaloc.images import list_images, stored_size
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.formats.arkit import distinguish_cameras
from mambaloc.importing.formats.builder import Checked, Matrices, Posed, build_capture, pinhole, validate_se3
from mambaloc.importing.formats.calibration_files import calibrated
from mambaloc.importing.formats.parsing import as_numbers, folder_name, number_of, read_text
from mambaloc.importing.formats.pose_lines import Direction, towards_world
from mambaloc.importing.formats.pose_rows import is_by_column, matrices_of
from mambaloc.text import natural

_SUFFIXES = (".txt", ".pose", ".npy")
_IMAGE_FOLDERS = ("rgb", "color", "images", "image", "img", "frames")
_OF_POSES = ("poses", "pose", "camera_poses", "cam_poses", "extrinsics")
_KIND = r"(?:colou?r|rgb|image|img|poses?|camera_pose|cam2world|extrinsics?)"
_MARKED = re.compile(rf"{_KIND}[._-]?(?=\d)|[._-]{_KIND}$", re.IGNORECASE)
_OTHER = re.compile(r"depth|mask|semantic|label|normal|confidence", re.IGNORECASE)
_DEEPEST = 3  # folders below the source
_MAX_FOLDERS = 1000
_SAMPLED = 20
_SPLITS = ("train", "val", "test")
_OFFICIAL_SIZE, _OFFICIAL_FOCAL_PX = (640, 480), 525.0  # of 7-Scenes' colour camera
_TABLE = "Write a table poses.csv with the columns image,x,y,z,qw,qx,qy,qz (camera centre, camera-to-world)."


@dataclass(frozen=True)
class _Group:
    """Images of one folder with their pose files, in natural order.

    Args:
        name: of the sequence.
        pairs: each image and its file.
        poses_alone: files without an image.
        beside: all images.
    """

    name: str
    pairs: list[tuple[Path, Path]]
    poses_alone: list[Path]
    beside: list[Path]


def is_pose_files(source: Path) -> bool:
    """Whether most images of a folder, or of one below it, have a file beside them that holds numbers of a pose."""
    group = next(_groups(source), None)
    if group is None:
        return False
    sampled = group.pairs[:: 1 + len(group.pairs) // _SAMPLED]
    return sum(_looks_like_pose(file) for _, file in sampled) > len(sampled) / 2


def read_pose_files(source: Path, direction: Direction = "world_from_cam") -> Capture:
    """Read every sequence below a folder, or one.

    Args:
        source: the folder.
        direction: in which the matrices transform.

    Raises:
        InputError: for a pose file that is damaged or of another kind, and where no file is found.
    """
    groups = list(_groups(source))
    if not groups:
        raise InputError(f"{source}: has no image with a pose file beside it, as X.jpg with X.txt. {_TABLE}")
    files = [file for group in groups for _, file in group.pairs]
    checked, by_column = _read_matrices(files)
    checked = towards_world(checked, direction)
    is_layout = all(file.name.endswith(".pose.txt") for file in files)
    images = [(group.name, image) for group in groups for image, _ in group.pairs]
    names, cameras, camera_choice = _cameras(source, [image for _, image in images], is_layout)
    depth, depth_camera = _depth(source, [image for _, image in images]) if is_layout else ([None] * len(images), None)
    posed = [
        Posed(
            image,
            name,
            checked[row],
            camera,
            split=_split(name),
            depth=each,
        )
        for row, ((name, image), camera, each) in enumerate(zip(images, names, depth, strict=True))
    ]
    choices = {
        **({"written": "column after column"} if by_column else {}),
        **({"cameras": camera_choice} if camera_choice else {}),
    }
    unit = "metres, as 7-Scenes has them" if is_layout else "unknown: pose files do not state it"
    return build_capture(
        "pose_files",
        source,
        posed,
        unit="metre" if is_layout else "unknown",
        choices={
            "axes": "OpenCV camera axes",
            "direction": "camera-to-world" if direction == "world_from_cam" else "world-to-camera, inverted",
            "scale": unit,
            "origin": "kept",
            "association": "each image with the file of its name",
            **choices,
            **checked.choices,
        },
        cameras=cameras,
        missing=[file.name for group in groups for file in group.poses_alone],
        beside=[image for group in groups for image in group.beside],
        depth_camera=depth_camera,
    )


def _groups(source: Path) -> Iterator[_Group]:
    """Folders at a source, or below it, in which at least half of the images have pose files."""
    for folder in _folders(source):
        own = [image for image in list_images(folder) if not _OTHER.search(image.name)]
        if own and (group := _paired(folder, _name(folder, source), own, _pose_files(folder))):
            yield group
            continue
        images = next((folder / name for name in _IMAGE_FOLDERS if (folder / name).is_dir()), None)
        poses = next((folder / name for name in _OF_POSES if (folder / name).is_dir()), None)
        if images is not None and poses is not None:
            group = _paired(folder, _name(folder, source), list_images(images), _pose_files(poses))
            if group:
                yield group


def _folders(source: Path) -> Iterator[Path]:
    if not source.is_dir():
        return
    found, level = 0, [source]
    for _ in range(_DEEPEST + 1):
        yield from level
        found += len(level)
        level = sorted((below for each in level for below in each.iterdir() if below.is_dir()), key=natural)
        if found + len(level) > _MAX_FOLDERS:
            return


def _name(folder: Path, source: Path) -> str:
    return folder_name(source) if folder == source else folder.relative_to(source).as_posix()


def _pose_files(folder: Path) -> list[Path]:
    return sorted((path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES), key=natural)


def _paired(folder: Path, name: str, images: list[Path], files: list[Path]) -> _Group | None:
    """Images and files of one name, or else of one number."""
    for key in (_key, number_of):
        by_key: dict[str | int, Path] = {}
        for file in files:
            by_key.setdefault(key(file), file)
        by_key.pop(-1, None)
        pairs = [(image, by_key[key(image)]) for image in images if key(image) in by_key]
        if 2 * len(pairs) >= len(images) and len({file for _, file in pairs}) == len(pairs) > 0:
            used = {file for _, file in pairs}
            alone = [file for file in by_key.values() if file not in used and _looks_like_pose(file)]
            return _Group(name, pairs, alone, images)
    return None


def _key(path: Path) -> str:
    """What an image and its pose file are both called: ``frame-000012`` of both ``.color.png`` and ``.pose.txt``."""
    return _MARKED.sub("", path.stem).lower()


def _split(name: str) -> str | None:
    first = name.partition("/")[0].lower()
    return first if first in _SPLITS else None


def _looks_like_pose(file: Path) -> bool:
    try:
        return len(_numbers(file)) in (7, 12, 16)
    except InputError:
        return False


def _numbers(file: Path) -> Matrices:
    """The numbers in a file, in a row; an array is read without unpickling anything.

    Raises:
        InputError: where it holds anything else.
    """
    if file.suffix.lower() == ".npy":
        try:
            array = np.load(file, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"{file}: is not an array of numbers ({error}). Save the 4x4 matrix alone.") from None
        if array.shape not in ((4, 4), (3, 4)) or array.dtype.kind not in "fiu":
            raise InputError(f"{file}: is an array of shape {array.shape}, not of a 4x4 matrix. Save that alone.")
        return np.array(array, dtype=np.float64).ravel()
    values = as_numbers(read_text(file, "the 16 numbers of a 4x4 matrix").replace(",", " ").split())
    if values is None or len(values) > 16:
        raise InputError(f"{file}: is not the 16 numbers of a 4x4 matrix. Export it again, or remove it.")
    return values


def _read_matrices(files: list[Path]) -> tuple[Checked, bool]:
    """Transforms of files, NaN of empty ones, and whether they are written column after column."""
    values = [_numbers(file) for file in files]
    usual = next((len(numbers) for numbers in values if len(numbers)), 0)
    values = [numbers if len(numbers) else np.full(usual, np.nan) for numbers in values]
    for file, numbers in zip(files, values, strict=True):
        if len(numbers) == 7:
            raise InputError(f"{file}: has 7 numbers, which do not say in which order a quaternion has them. {_TABLE}")
        if len(numbers) not in (12, 16) or len(numbers) != len(values[0]):
            raise InputError(
                f"{file}: has {len(numbers)} numbers, not {len(values[0])} of a matrix as {files[0].name}. "
                "Export it again, or remove it."
            )
    table = np.stack(values)
    by_column = bool(is_by_column(table))
    return validate_se3(matrices_of(table, by_column), lambda row: str(files[row])), by_column


def _cameras(source: Path, images: list[Path], is_layout: bool) -> tuple[Sequence[str | None], dict[str, Camera], str]:
    """The name of each image's camera, cameras by name, and what was decided: by files, or that of 7-Scenes."""
    found, camera_choice = calibrated(source, images)
    if found:
        return *distinguish_cameras([found[image] for image in images]), camera_choice
    official = _official_camera(images[0]) if is_layout else None
    return (
        ([None] * len(images), {}, camera_choice)
        if official is None
        else (["colour"] * len(images), {"colour": official}, "")
    )


def _official_camera(image: Path) -> Camera | None:
    """The colour camera of 7-Scenes, where an image has its size."""
    width, height = stored_size(image)
    if (width, height) != _OFFICIAL_SIZE:
        return None
    return pinhole((width, height), (_OFFICIAL_FOCAL_PX,) * 2, ((width - 1) / 2, (height - 1) / 2), image)


def _depth(source: Path, images: list[Path]) -> tuple[list[Path | None], Matrices | None]:
    """Depth frames of images and their camera, where a file has it or it is the official sensor's."""
    files = [path if (path := depth_path(image)).is_file() else None for image in images]
    first = next((path for path in files if path is not None), None)
    with_intrinsics = next(
        (path for path in (source, source.resolve().parent) if (path / INTRINSICS_FILE).is_file()), None
    )
    if first is None:
        return files, None
    height, width = read_depth_mm(first).shape
    if with_intrinsics is None and (width, height) != _OFFICIAL_SIZE:
        return [None] * len(images), None
    return files, read_depth_intrinsics(with_intrinsics or source, (width, height))
