"""RGB-D recordings in the layout of 7-Scenes: ``seq-NN/frame-NNNNNN`` with colour, depth and a pose each.

The layout itself is read by :mod:`mambaloc.data.datasets.seven_scenes`. Depth is in millimetres; its camera is
``camera-intrinsics.txt`` or, without that file, the official depth sensor's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mambaloc.data.cameras import frame_intrinsics
from mambaloc.data.datasets.seven_scenes import read_split
from mambaloc.data.depth_frames import depth_path, read_depth_intrinsics, read_depth_mm
from mambaloc.data.frames import BadFrames, Split
from mambaloc.images import stored_size
from mambaloc.importing.capture import Capture
from mambaloc.importing.formats.builder import Pose, Posed, build_capture, pinhole
from mambaloc.runtime.rotations import matrix_from_quaternion
from mambaloc.text import natural

_CHOICES = {
    "axes": "OpenCV camera axes, as the format has them",
    "direction": "camera-to-world, as the format has it",
    "scale": "metres, as the format has them",
    "origin": "kept",
}
_SPLITS: tuple[Split, ...] = ("train", "test")


def is_seven_scenes(source: Path) -> bool:
    """Whether a folder is laid out as a scene of 7-Scenes."""
    return all((source / f"{split.title()}Split.txt").is_file() for split in _SPLITS) and any(source.glob("seq-*"))


def read_seven_scenes(source: Path) -> Capture:
    """Read both splits; frames without a usable pose or image are left out, and counted.

    Raises:
        InputError: for a split file, a depth frame or an image that is missing or damaged.
    """
    posed, bad = [], BadFrames("skip")
    for split in _SPLITS:
        frames = read_split(source, split, bad)
        for row, image in enumerate(frames.image_paths):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = matrix_from_quaternion(frames.quaternion[row]), frames.position_m[row]
            depth = depth_path(image)
            depth_file = depth if depth.is_file() else None
            posed.append(Posed(image, frames.sequences[row], Pose(pose), "colour", split=split, depth=depth_file))
    matrix = frame_intrinsics("7scenes", source, frames)[0]
    size = stored_size(posed[0].image)
    camera = pinhole(size, (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]), source)
    depth_files = [each.depth for each in posed if each.depth is not None]
    depth_camera = None
    if depth_files:
        shape = read_depth_mm(depth_files[0]).shape
        depth_camera = read_depth_intrinsics(source, (shape[1], shape[0]))
    return build_capture(
        "7scenes",
        source,
        sorted(posed, key=lambda each: natural(each.image)),
        unit="metre",
        choices=_CHOICES,
        cameras={"colour": camera},
        missing=[str(each.path.name) for each in bad.rejected],
        depth_camera=depth_camera,
    )
