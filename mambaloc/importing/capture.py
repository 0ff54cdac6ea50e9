"""What every reader of a foreign format gives: posed images in this project's conventions, and what was decided."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.tracks import Tracks
from mambaloc.runtime.camera_models import Pinhole
from mambaloc.runtime.world import World

Unit = Literal["metre", "unknown"]

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes of OpenGL, ARKit and ARCore (x right, y up, z backwards) in OpenCV's, and the other way."""


@dataclass(frozen=True)
class Camera(Pinhole):
    """A capture's camera, in pixels of its images; the centre of the top-left pixel is (0, 0).

    Args:
        distorted: pixels (N, 2) of rays (N, 2), which are ``x / z`` and ``y / z``; None for a pinhole. Only a
            :class:`~mambaloc.runtime.camera_models.CameraModel` can be kept, for images to localize.
        model: what the format calls it.
    """

    distorted: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    model: str = "pinhole"


@dataclass(frozen=True)
class Depth:
    """Depth frames of a capture's images, seen from the same place.

    Args:
        files: of each image the 16-bit PNG, or None; 0 and 65535 are pixels without a measurement.
        intrinsics: (3, 3), in pixels of depth frames; another lens than the images' where the sensor has one.
        step: how far one more in a file is, in the capture's unit.
        confidence: of each depth frame the 8-bit PNG of its size, or None; pixels that are 0 there are left out. Empty
            where the format has none.
    """

    files: tuple[Path | None, ...]
    intrinsics: NDArray[np.float64]
    step: float = 0.001
    confidence: tuple[Path | None, ...] = ()


@dataclass(frozen=True)
class Capture:
    """Posed images, sequence after sequence, each in the order it was taken.

    Args:
        kind: the format, as :data:`mambaloc.importing.registry.FORMATS` names it.
        images: N files, all there.
        sequences: N names of recordings.
        world_from_cam: (N, 4, 4) float64, OpenCV camera axes.
        unit: of positions: ``unknown`` where the format's scale is arbitrary.
        metres_per_unit: what the source says of its unit; None where it says nothing, or always has the same.
        choices: what was decided of axes, direction, scale and origin, and why, by name; goes into ``scene.json``.
        cameras: by name; empty if the format has none.
        camera_of: N names, or None if the format has no cameras.
        time_s: (N,); None if the format has no times.
        split: N of ``train``, ``val``, ``test``; None if the format has no splits.
        split_concern: what the capture has that gives no split, or only part of one, in a line; empty where nothing.
        poses_without_image: what the format names and is not there.
        images_without_pose: images beside those used.
        left_out: why frames are left out that the format itself marks as bad, by file.
        depth: of the images, where the format has it and the images are those of a pinhole.
        tracks: points that the format says the images see.
        world: where positions lie in the source's world.
    """

    kind: str
    images: tuple[Path, ...]
    sequences: tuple[str, ...]
    world_from_cam: NDArray[np.float64]
    unit: Unit
    choices: Mapping[str, str]
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    camera_of: tuple[str, ...] | None = None
    time_s: NDArray[np.float64] | None = None
    split: tuple[str, ...] | None = None
    split_concern: str = ""
    poses_without_image: tuple[str, ...] = ()
    images_without_pose: tuple[Path, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    depth: Depth | None = None
    tracks: Tracks | None = None
    metres_per_unit: float | None = None
    world: World = field(default_factory=World)
