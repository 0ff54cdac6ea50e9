"""The camera rule of all formats: a camera is judged by its own images.

An image of its camera's shape and another size was resized with all it shows: its camera scales with it. Images
whose sizes differ by a few percent, as COLMAP's undistorter leaves them, are cropped to one size, and their principal
points move with the corner. An image of any other shape was cropped where nothing says: no camera is right for it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from mambaloc.images import CORNER_PX, center_corner
from mambaloc.importing.capture import Camera
from mambaloc.importing.undistort.pinhole import pinhole_of
from mambaloc.runtime.camera_models import CameraModel, Size, is_same_shape, scaled_intrinsics
from mambaloc.runtime.undistortion import Maps, sampled_at

_NEAR = 0.05
_MAPS_KEPT = 4  # of cameras, at a time: each is as large as a few images


class FittedCameras:
    """A capture's cameras, each fitted to the sizes of its own images."""

    def __init__(self, cameras: Mapping[str, Camera]) -> None:
        self.cameras = cameras
        self.found: dict[tuple[str, Size], tuple[Camera, Camera] | None] = {}
        self.maps = lru_cache(_MAPS_KEPT)(self._maps)
        self.lock = Lock()  # the first images of a camera all ask for its maps

    def size(self, name: str) -> Size:
        """Size of the images that a camera is given for."""
        return self.cameras[name].size

    def fitted(self, name: str, size: Size) -> tuple[Camera, Maps | None] | None:
        """The lens in pixels of an image of that size, and maps that undistort it; None where the shapes differ."""
        with self.lock:
            if (name, size) not in self.found:
                lens = fitted(self.cameras[name], size)
                self.found[name, size] = None if lens is None else (lens, pinhole_of(name, lens))
            found = self.found[name, size]
            return found and (found[0], self.maps(name, size))

    def as_used(
        self, camera_of: Sequence[str] | None, sizes: Sequence[Size], common: Mapping[Size, Size]
    ) -> tuple[tuple[str, ...] | None, dict[str, Camera], dict[str, Camera]]:
        """The name of each image's camera, and the pinholes and the lenses that these names mean.

        A camera of images of several sizes is as many; all but that of most images are named by their size, too.

        Args:
            camera_of: the name of each image's camera in the capture; None where it has none.
            sizes: of each image, as it was fitted.
            common: what each size is cropped to.
        """
        if camera_of is None:
            return None, {}, {}
        names: dict[tuple[str, Size], str] = {}
        for (name, size), _ in Counter(zip(camera_of, sizes, strict=True)).most_common():
            names[name, size] = name if name not in names.values() else f"{name}-{size[0]}x{size[1]}"
        pinholes, lenses = {}, {}
        for (name, size), new in sorted(names.items()):
            found = self.found[name, size]
            assert found is not None
            lenses[new], pinholes[new] = found[0], cropped(found[1], common[size])
        used = tuple(names[pair] for pair in zip(camera_of, sizes, strict=True))
        return used, pinholes, lenses

    def _maps(self, name: str, size: Size) -> Maps | None:
        found = self.found[name, size]
        return None if found is None or found[0].distorted is None else sampled_at(found[0].distorted, found[1])


def fitted(camera: Camera, size: Size) -> Camera | None:
    """A camera in pixels of its image of a size (width, height); None where that is of another shape."""
    if size == camera.size:
        return camera
    return scaled(camera, size) if is_same_shape(camera.size, size) else None


def scaled(camera: Camera, size: Size) -> Camera:
    """A camera in pixels of its images resized to (width, height), each side by itself, as COLMAP does."""
    x, y = size[0] / camera.width, size[1] / camera.height
    lens = camera.distorted

    def distorted(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        assert lens is not None
        return (lens(rays) + CORNER_PX) * (x, y) - CORNER_PX

    there = lens.scaled((x, y)) if isinstance(lens, CameraModel) else lens and distorted
    focal_px, center_px = scaled_intrinsics(camera.focal_px, camera.center_px, (x, y))
    return Camera(*size, focal_px, center_px, there, camera.model)


def cropped(pinhole: Camera, size: Size) -> Camera:
    """A pinhole of the middle of its images, of a size (width, height)."""
    width, height = size
    top, left = center_corner((pinhole.height, pinhole.width), (height, width))
    cx, cy = pinhole.center_px
    return replace(pinhole, width=width, height=height, center_px=(cx - left, cy - top))


def common_sizes(sizes: Iterable[Size]) -> dict[Size, Size]:
    """What images of each size are cropped to: the largest that all sizes near it hold.

    A size is near another where both sides differ by a few percent. Of several, it joins the one of most images.
    """
    counts = Counter(sizes)
    groups: dict[Size, list[Size]] = {}
    for size in sorted(counts, key=lambda size: (-counts[size], size)):
        common = next((other for other in groups if _is_near(size, other)), size)
        groups.setdefault(common, []).append(size)
    found = {}
    for group in groups.values():
        width, height = min(width for width, _ in group), min(height for _, height in group)
        found.update(dict.fromkeys(group, (width, height)))
    return found


def _is_near(size: Size, other: Size) -> bool:
    return all(abs(a - b) <= _NEAR * b for a, b in zip(size, other, strict=True))
