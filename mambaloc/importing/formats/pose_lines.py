"""Files of a pose a line that are neither KITTI's nor TUM's, beside their images.

Sixteen numbers are a 4x4 matrix, camera-to-world; lines without a name are those of the images in natural order. A
name may stand before twelve or sixteen numbers, or before seven: ``name qw qx qy qz tx ty tz`` is **world-to-camera**,
scalar first, as in COLMAP's ``images.txt`` and hloc's results; with the position first, a line that names the columns
must say where the scalar is, and poses are camera-to-world. ``intrinsics.txt`` with lines ``name fx fy cx cy width
height`` is Map-free's.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import IMAGE_SUFFIXES, list_images
from mambaloc.importing.capture import Capture
from mambaloc.importing.formats.builder import (
    Checked,
    Posed,
    build_capture,
    from_quaternions,
    validate_se3,
)
from mambaloc.importing.formats.column_names import scale_of
from mambaloc.importing.formats.finding import count_there, find_images
from mambaloc.importing.formats.map_free import cameras_by_image
from mambaloc.importing.formats.parsing import Table, first_with_images, folder_name, images_in_same_folders, only_file
from mambaloc.importing.formats.pose_rows import IMAGE_FOLDERS, Layout, layout_of, matrices_of, pose_files, read_rows
from mambaloc.importing.formats.timing import pair

Direction = Literal["world_from_cam", "cam_from_world"]

_CHOICES = {"axes": "OpenCV camera axes", "scale": "unknown: a pose file does not state it", "origin": "kept"}
_TABLE = "Write a table poses.csv with the columns image,x,y,z,qw,qx,qy,qz (camera centre, camera-to-world)."
_WORLD_FROM_CAM = "camera-to-world"
_CAM_FROM_WORLD = "world-to-camera, inverted"


def is_pose_lines(source: Path) -> bool:
    """Whether a source is, or a folder holds, a file of poses by its lines."""
    return bool(_files(source))


def read_pose_lines(source: Path, direction: Direction | None = None, images: Path | None = None) -> Capture:
    """Read a file of poses.

    Args:
        source: the file, or its folder.
        direction: in which its poses transform; as the module says unless given.
        images: the folder of the images; found beside the file unless given.

    Raises:
        InputError: for a file that is damaged, can be read in more ways than one, or does not fit its images.
    """
    found = _files(source)
    if not found:
        raise InputError(f"{source}: has no lines of poses: 12 or 16 numbers of a matrix, or a name and 7. {_TABLE}")
    path = only_file(found, source)
    layout = found[path]
    if not layout.is_named and layout.count == 7:
        raise InputError(f"{path}: has 7 numbers a line, which do not say whose pose each is. {_TABLE}")
    if not layout.is_named:
        how = {**_CHOICES, **_by_column(layout)}
        return read_in_order(path, layout, "pose_lines", how, direction or "world_from_cam", images)
    return _read_named(path, layout, direction, images)


def read_in_order(
    path: Path,
    layout: Layout,
    kind: str,
    choices: Mapping[str, str],
    direction: Direction = "world_from_cam",
    given: Path | None = None,
) -> Capture:
    """Read matrices without names, which are those of the images beside their file, in natural order.

    Args:
        path: the file.
        layout: of its lines.
        kind: of the capture.
        choices: made so far.
        direction: in which poses transform.
        given: the folder of the images; found beside the file unless given.

    Raises:
        InputError: for a file that is damaged, or another number of images.
    """
    table = read_rows(path, layout, " ".join(["number"] * layout.count))
    folder = first_with_images([given] if given else [path.parent / name for name in IMAGE_FOLDERS])
    images = list_images(folder)
    if len(images) != len(table.lines):
        raise InputError(
            f"{path}: has {len(table.lines)} poses, and {folder} {len(images)} images; give as many, in the same "
            "order, or write each image's name before its pose"
        )
    checked = validate_se3(matrices_of(table.numbers, layout.by_column), table.where)
    checked = towards_world(checked, direction)
    sequence = folder_name(path.parent)
    return build_capture(
        kind,
        path.parent,
        [Posed(image, sequence, checked[row]) for row, image in enumerate(images)],
        unit="unknown",
        choices={
            **choices,
            "direction": _WORLD_FROM_CAM if direction == "world_from_cam" else _CAM_FROM_WORLD,
            "scale": _CHOICES["scale"],
            "association": "in the order of file names",
            **checked.choices,
        },
    )


def _files(source: Path) -> dict[Path, Layout]:
    if not source.is_file():
        return pose_files(source)
    layout = layout_of(source)
    return {} if layout is None else {source: layout}


def _read_named(path: Path, layout: Layout, direction: Direction | None, given: Path | None) -> Capture:
    table = read_rows(path, layout, f"name and {layout.count} numbers")
    if layout.count == 7:
        checked, direction, choices = _of_sevens(table, layout, direction)
    else:
        direction = direction or "world_from_cam"
        checked = validate_se3(matrices_of(table.numbers, layout.by_column), table.where)
        choices = {"direction": _WORLD_FROM_CAM if direction == "world_from_cam" else _CAM_FROM_WORLD}
        choices |= _by_column(layout)
    checked = towards_world(checked, direction)
    rows, how, missing = _images_of(path, table, given)
    cameras = cameras_by_image(path.parent / "intrinsics.txt")
    names = {camera: f"camera-{number}" for number, camera in enumerate(dict.fromkeys(cameras.values()))}
    camera_of = {name: names[camera] for name, camera in cameras.items()}
    posed = [
        Posed(
            image,
            _sequence(image, given or path.parent),
            checked[row],
            camera_of.get(table.words[row].replace("\\", "/")),
            time_s,
        )
        for image, row, time_s in rows
    ]
    length_m = layout.metres_per_unit(path) if layout.count == 7 else None
    return build_capture(
        "pose_lines",
        path,
        sorted(posed, key=lambda each: each.time_s or 0.0),
        unit="unknown",
        choices={
            **_CHOICES,
            **choices,
            "scale": scale_of(length_m, _CHOICES["scale"]),
            "association": how,
            **checked.choices,
        },
        metres_per_unit=length_m,
        cameras={name: camera for camera, name in names.items()},
        missing=missing,
        beside=images_in_same_folders(image for image, _, _ in rows),
    )


def _of_sevens(table: Table, layout: Layout, direction: Direction | None) -> tuple[Checked, Direction, dict[str, str]]:
    """Poses of a position and a quaternion, in which direction they transform, and what was decided."""
    comes_first = layout.quaternion == 0
    if layout.is_unclear:
        raise InputError(f"{table.path}: its header does not say where the scalar of the quaternions is. {_TABLE}")
    if (comes_first and not layout.is_text) or (not comes_first and layout.scalar is None):
        raise InputError(
            f"{table.path}: its lines do not say {'in which direction' if comes_first else 'where'} "
            f"{'poses transform' if comes_first else 'the scalar of their quaternions is'}. {_TABLE}"
        )
    scalar = layout.scalar or "first"
    quaternion = table.numbers[:, layout.quaternion :][:, :4]
    position = table.numbers[:, 4:] if comes_first else table.numbers[:, :3]
    if scalar == "last":
        quaternion = np.roll(quaternion, 1, axis=1)
    checked = from_quaternions(position, quaternion, table.where)
    direction = direction or ("cam_from_world" if comes_first else "world_from_cam")
    choices = {"direction": f"{_WORLD_FROM_CAM if direction == 'world_from_cam' else _CAM_FROM_WORLD}, scalar {scalar}"}
    return checked, direction, choices


def towards_world(checked: Checked, direction: Direction) -> Checked:
    """``world_from_cam`` of transforms of a direction."""
    return checked if direction == "world_from_cam" else checked.inverse()


def _images_of(
    path: Path, table: Table, given: Path | None
) -> tuple[list[tuple[Path, int, float | None]], str, list[str]]:
    """Each image with its row and time, how they were associated, and the names whose images are not there."""
    folders = [given] if given else [path.parent, *(path.parent / name for name in IMAGE_FOLDERS[:-1])]
    if all(PurePosixPath(word).suffix.lower() in IMAGE_SUFFIXES for word in table.words):
        folder = max(folders, key=lambda each: count_there(each, table.words))
        found = find_images(folder, [(word, table.where(row)) for row, word in enumerate(table.words)])
        missing = [word for word, file in zip(table.words, found.files, strict=True) if file in found.missing]
        frames: list[tuple[Path, int, float | None]] = [
            (file, row, None) for row, file in enumerate(found.files) if file not in found.missing
        ]
        return frames, "; ".join(filter(None, ("by name", found.elsewhere))), missing
    images = list_images(first_with_images([given] if given else [path.parent / name for name in IMAGE_FOLDERS]))
    pairing = pair(images, table.words, path)
    return pairing.frames, pairing.how, pairing.missing


def _sequence(image: Path, root: Path) -> str:
    return image.parent.relative_to(root).as_posix() if image.parent != root else folder_name(root)


def _by_column(layout: Layout) -> dict[str, str]:
    return {"matrices": "written column after column"} if layout.by_column else {}
