"""Scenes of Map-free relocalization: two scans of a place, ``seq0`` and ``seq1``, that share a world.

``poses.txt`` has lines ``seq1/frame_00012.jpg qw qx qy qz tx ty tz``: world-to-camera, scalar first, in metres, in
OpenCV's axes. Zeros throughout mark a pose that is kept back, as in the scenes of the test set, and a frame without a
line was lost. ``intrinsics.txt`` has lines ``seq1/frame_00012.jpg fx fy cx cy width height``, a camera an image,
whose pixels count from the centre of the top-left one, as ``correct_intrinsic_scale`` of the reference loader has it.
``poses_device.txt`` are those of the phone's own tracking, in worlds of their own. Source: readme,
``lib/datasets/mapfree.py`` and ``utils.py`` of github.com/nianticlabs/map-free-reloc (Arnold et al. 2022).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.formats.arkit import distinguish_cameras
from mambaloc.importing.formats.builder import Posed, build_capture, from_quaternions, pinhole
from mambaloc.importing.formats.finding import find_images
from mambaloc.importing.formats.parsing import as_numbers, folder_name, images_in_same_folders, read_lines, read_table
from mambaloc.importing.formats.pose_rows import layout_of

_POSES, _INTRINSICS = "poses.txt", "intrinsics.txt"
_ROW = "name qw qx qy qz tx ty tz"
_UNREAD = ("poses_device.txt", "overlaps.npz")
_CHOICES = {
    "axes": "OpenCV camera axes, as the format has them",
    "direction": "world-to-camera, inverted, scalar first",
    "scale": "metres, as the format has them",
    "origin": "kept",
}


def is_map_free(source: Path) -> bool:
    """Whether a folder is such a scene, by the lines of its two files."""
    poses, intrinsics = source / _POSES, source / _INTRINSICS
    if not poses.is_file() or not intrinsics.is_file():
        return False
    layout = layout_of(poses)
    is_named = layout is not None and layout.is_text and (layout.count, layout.quaternion) == (7, 0)
    return is_named and any(len(words) == 7 for _, words in read_lines(intrinsics, "intrinsics")[:1])


def read_map_free(source: Path, images: Path | None = None) -> Capture:
    """Read both scans of a scene.

    Args:
        source: the scene's folder.
        images: the folder that holds ``seq0`` and ``seq1``; the scene's own unless given.

    Raises:
        InputError: for a file that is missing or damaged, or where no image has a pose.
    """
    table = read_table(source / _POSES, 7, _ROW, named=True, may_lack_fix=True)
    checked = from_quaternions(table.numbers[:, 4:], table.numbers[:, :4], table.where)
    world_from_cam = checked.inverse()
    root = source if images is None else images
    found = find_images(root, [(name, table.where(row)) for row, name in enumerate(table.words)])
    there = [row for row, file in enumerate(found.files) if file not in found.missing]
    lenses = cameras_by_image(source / _INTRINSICS)
    has_lens = all(table.words[row] in lenses for row in there)
    names, cameras = distinguish_cameras([lenses[table.words[row]] for row in there] if has_lens else [])
    camera_of: Sequence[str | None] = names or [None] * len(there)
    posed = [
        Posed(
            found.files[row],
            _sequence(found.files[row], root),
            world_from_cam[row],
            camera,
        )
        for row, camera in zip(there, camera_of, strict=True)
    ]
    unread = [name for name in _UNREAD if (source / name).is_file()]
    return build_capture(
        "map_free",
        source,
        posed,
        unit="metre",
        choices={
            **_CHOICES,
            **({"not read": ", ".join(unread)} if unread else {}),
            **({} if has_lens else {"cameras": f"none: {_INTRINSICS} does not name every image"}),
            **found.choices,
            **checked.choices,
        },
        cameras=cameras,
        missing=[table.words[row] for row, file in enumerate(found.files) if file in found.missing],
        beside=images_in_same_folders(found.files[row] for row in there),
    )


def cameras_by_image(path: Path) -> dict[str, Camera]:
    """Cameras by image's name, of lines ``name fx fy cx cy width height``; none where there is no such file."""
    if not path.is_file():
        return {}
    found = {}
    for line, (name, *words) in read_lines(path, "lines 'name fx fy cx cy width height'"):
        values = as_numbers(words)
        if values is None or len(values) != 6 or not np.isfinite(values).all():
            return {}
        fx, fy, cx, cy, width, height = values.tolist()
        found[name] = pinhole((width, height), (fx, fy), (cx, cy), f"{path}, line {line}")
    return found


def _sequence(image: Path, root: Path) -> str:
    return image.parent.relative_to(root).as_posix() if image.parent != root else folder_name(root)
