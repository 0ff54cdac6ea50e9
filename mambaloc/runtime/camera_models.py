"""Cameras as data: a pinhole, and OpenCV's two models of a lens that distorts.

Pixels are counted from the centre of the top-left one, (0, 0). Source: docs.opencv.org, modules calib3d and fisheye.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.images import CORNER_PX, LARGEST_SIDE_PX

Floats = NDArray[np.float64]
Size = tuple[int, int]
"""Width and height, in pixels."""

_LARGEST = 1e7


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics without distortion.

    Args:
        width: of its images, in pixels.
        height: in pixels.
        focal_px: along x and y.
        centre_px: principal point, x and y.
    """

    width: int
    height: int
    focal_px: tuple[float, float]
    center_px: tuple[float, float]

    @property
    def size(self) -> Size:
        """Width and height."""
        return self.width, self.height

    @property
    def intrinsics(self) -> Floats:
        """The pinhole matrix, (3, 3)."""
        return matrix_of(self.focal_px, self.center_px)


@dataclass(frozen=True)
class CameraModel(ABC):
    """How a camera projects rays, by one of OpenCV's models.

    Args:
        focal_px: along x and y.
        centre_px: principal point.
        coefficients: in OpenCV's order.
    """

    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    coefficients: Sequence[float]

    name: ClassVar[str]
    counts: ClassVar[tuple[int, ...]]
    """How many coefficients there may be."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", tuple(map(float, self.coefficients)))  # hashable

    @abstractmethod
    def __call__(self, rays: Floats) -> Floats:
        """Pixels (N, 2) of rays (N, 2), which are ``x / z`` and ``y / z``."""

    @abstractmethod
    def of_pixels(self, pinhole: Pinhole) -> NDArray[np.float32]:
        """The same of the rays of all pixels of a pinhole's image, (H, W, 2) float32, a hundred times as fast."""

    def scaled(self, scale: Sequence[float]) -> Self:
        """The same of images resized by factors of width and height."""
        focal, center = scaled_intrinsics(self.focal_px, self.center_px, scale)
        return replace(self, focal_px=focal, center_px=center)


@dataclass(frozen=True)
class OpenCVModel(CameraModel):
    """OpenCV's pinhole with distortion, Brown's: k1, k2, p1, p2, then k3, then k4 to k6, and so on."""

    name = "pinhole"
    counts = (4, 5, 8, 12, 14)

    def __call__(self, rays: Floats) -> Floats:
        """Pixels of rays, both (N, 2)."""
        points = np.concatenate((rays, np.ones((len(rays), 1))), axis=1)[:, None]
        matrix, none = matrix_of(self.focal_px, self.center_px), np.zeros(3)
        return cv2.projectPoints(points, none, none, matrix, np.array(self.coefficients))[0][:, 0].astype(np.float64)

    def of_pixels(self, pinhole: Pinhole) -> NDArray[np.float32]:
        """Pixels of a pinhole's pixels, (H, W, 2) float32."""
        matrix, coefficients = matrix_of(self.focal_px, self.center_px), np.array(self.coefficients)
        maps = cv2.initUndistortRectifyMap(matrix, coefficients, None, pinhole.intrinsics, pinhole.size, cv2.CV_32FC1)
        return np.dstack(maps)


@dataclass(frozen=True)
class FisheyeModel(CameraModel):
    """OpenCV's fisheye, an equidistant lens: k1 to k4."""

    name = "fisheye"
    counts = (4,)

    def __call__(self, rays: Floats) -> Floats:
        """Pixels of rays, both (N, 2)."""
        points, matrix = np.ascontiguousarray(rays)[:, None], matrix_of(self.focal_px, self.center_px)
        return cv2.fisheye.distortPoints(points, matrix, np.array(self.coefficients))[:, 0].astype(np.float64)

    def of_pixels(self, pinhole: Pinhole) -> NDArray[np.float32]:
        """Pixels of a pinhole's pixels, (H, W, 2) float32."""
        matrix, coefficients = matrix_of(self.focal_px, self.center_px), np.array(self.coefficients)
        maps = cv2.fisheye.initUndistortRectifyMap(
            matrix, coefficients, np.eye(3), pinhole.intrinsics, pinhole.size, cv2.CV_32FC1
        )
        return np.dstack(maps)


MODELS: dict[str, type[CameraModel]] = {model.name: model for model in (OpenCVModel, FisheyeModel)}
"""By the name that files have."""


def is_same_shape(size: Sequence[float], other: Sequence[float]) -> bool:
    """Whether one scale leads from a size to another, each of whose sides may be rounded by less than a pixel."""
    difference = abs(other[0] / size[0] - other[1] / size[1])
    return difference < 1 / size[0] + 1 / size[1]


def scaled_intrinsics(
    focal_px: Sequence[float], center_px: Sequence[float], scale: Sequence[float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Focal lengths and principal point in images resized by factors of width and height; corners stay corners."""
    (fx, fy), (cx, cy), (x, y) = focal_px, center_px, scale
    return (fx * x, fy * y), ((cx + CORNER_PX) * x - CORNER_PX, (cy + CORNER_PX) * y - CORNER_PX)


def matrix_of(focal_px: Sequence[float], center_px: Sequence[float]) -> Floats:
    """The pinhole matrix of focal lengths and principal point, (3, 3)."""
    return np.array([[focal_px[0], 0, center_px[0]], [0, focal_px[1], center_px[1]], [0, 0, 1]])


def numbers_to_json(size: Size, focal_px: Sequence[float], center_px: Sequence[float]) -> dict[str, Any]:
    """Size, focal lengths and principal point as ``scene.json`` and contracts have them."""
    return {"width": size[0], "height": size[1], "focal_px": list(focal_px), "centre_px": list(center_px)}


def model_to_json(model: CameraModel, size: Size) -> dict[str, Any]:
    """The same of a camera that distorts."""
    numbers = numbers_to_json(size, model.focal_px, model.center_px)
    return {"opencv": model.name, **numbers, "coefficients": list(model.coefficients)}


def pinhole_from_json(value: Mapping[str, Any]) -> Pinhole:
    """Read what :func:`numbers_to_json` gives.

    Raises:
        KeyError, TypeError, ValueError, OverflowError: for anything else.
    """
    width, height = int(value["width"]), int(value["height"])
    (fx, fy), (cx, cy) = (map(float, value[key]) for key in ("focal_px", "centre_px"))
    if not 1 <= min(width, height) <= max(width, height) <= LARGEST_SIDE_PX:
        raise ValueError(f"images of {width}x{height}")
    if not all(abs(each) < _LARGEST for each in (fx, fy, cx, cy)) or min(fx, fy) <= 0:
        raise ValueError(f"focal length {fx}, {fy}, centre {cx}, {cy}")
    return Pinhole(width, height, (fx, fy), (cx, cy))


def model_from_json(value: Mapping[str, Any]) -> tuple[CameraModel, Size]:
    """Read what :func:`model_to_json` gives.

    Raises:
        KeyError, TypeError, ValueError, OverflowError: for anything else.
    """
    pinhole = pinhole_from_json(value)
    model = MODELS[value["opencv"]](pinhole.focal_px, pinhole.center_px, value["coefficients"])
    if len(model.coefficients) not in model.counts or not all(map(math.isfinite, model.coefficients)):
        raise ValueError(f"coefficients {model.coefficients}")
    return model, pinhole.size
