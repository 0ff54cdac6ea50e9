"""SIFT keypoints with RootSIFT descriptors, and how descriptors are compared."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mambaloc.errors import InputError
from mambaloc.images import Image

Floats = NDArray[np.float64]

DESCRIPTOR_SCALE = 512.0
"""A stored descriptor is the unit vector times this, rounded and cut to 0..255, as COLMAP has it."""

_MAX_KEYPOINTS = 1000
_CONTRAST = 0.02  # half of OpenCV's default: small images have few keypoints


@dataclass(frozen=True)
class Features:
    """Keypoints of one image.

    Shape:
        ``pixels`` (N, 2) in the image as it was searched; ``descriptors`` (N, 128) float32 of unit length.

    Args:
        pixels: the centre of the top-left pixel is (0, 0).
        descriptors: RootSIFT, so that their product is the Bhattacharyya coefficient of two histograms.
        intrinsics: (3, 3) pinhole matrix of the image as it was searched.
        size: its (width, height).
    """

    pixels: Floats
    descriptors: NDArray[np.float32]
    intrinsics: Floats
    size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.pixels)

    def select(self, rows: NDArray[np.generic]) -> Features:
        """Some of the keypoints: indices or a mask."""
        return Features(self.pixels[rows], self.descriptors[rows], self.intrinsics, self.size)

    @cached_property
    def rays(self) -> Floats:
        """Where keypoints lie in the plane at depth 1, (N, 2)."""
        return normalized(self.pixels, self.intrinsics)

    @property
    def corner_rays(self) -> Floats:
        """The same of the image's upper left and lower right corner, (2, 2)."""
        return normalized([(-0.5, -0.5), (self.size[0] - 0.5, self.size[1] - 0.5)], self.intrinsics)


class Keypoints(NamedTuple):
    """What SIFT finds in an image once it is made smaller, whatever its camera.

    Shape:
        ``pixels`` (N, 2) float32 of the smaller image; ``histograms`` (N, 128) uint8; ``size`` and ``full_size``
        (2,), width and height of the smaller image and of the image itself.
    """

    pixels: NDArray[np.float32]
    histograms: NDArray[np.uint8]
    size: NDArray[np.int64]
    full_size: NDArray[np.int64]

    def described(self, intrinsics: ArrayLike) -> Features:
        """With RootSIFT descriptors, and the camera of the image itself, (3, 3).

        Raises:
            InputError: where the intrinsics do not fit the image.
        """
        (width, height), size = self.full_size.tolist(), (int(self.size[0]), int(self.size[1]))
        check_intrinsics(intrinsics, (width, height))
        floats = self.histograms.astype(np.float32)
        root = np.sqrt(floats / np.maximum(floats.sum(axis=1, keepdims=True), 1))
        small = rescaled_intrinsics(intrinsics, (width, height), size)
        return Features(self.pixels.astype(np.float64), root, small, size)


def find_keypoints(image: Image, scale: float) -> Keypoints:
    """Find the keypoints of an image once it is made smaller.

    Args:
        image: RGB (H, W, 3), ``uint8``, without distortion.
        scale: width of the smaller image over that of the image; 1 at most counts.
    """
    height, width = image.shape[:2]
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    size = (max(1, round(width * min(scale, 1))), max(1, round(height * min(scale, 1))))
    if size != (width, height):
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    # The precise upscale puts keypoints where they are; otherwise each is 0.25 px to the lower right.
    sift = cv2.SIFT.create(_MAX_KEYPOINTS, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    keypoints, histograms = sift.detectAndCompute(grey, None)
    pixels = np.array([point.pt for point in keypoints], np.float32).reshape(-1, 2)
    whole = np.zeros((0, 128), np.uint8) if histograms is None else histograms.astype(np.uint8)  # they are whole
    return Keypoints(pixels, whole, np.array(size), np.array((width, height)))


def detect_features(image: Image, intrinsics: ArrayLike, scale: float) -> Features:
    """Find and describe the keypoints of an image; arguments are those of :func:`find_keypoints`.

    Raises:
        InputError: where the intrinsics, (3, 3), do not fit the image.
    """
    check_intrinsics(intrinsics, (image.shape[1], image.shape[0]))
    return find_keypoints(image, scale).described(intrinsics)


def rescaled_intrinsics(intrinsics: ArrayLike, size: tuple[int, int], new_size: tuple[int, int]) -> Floats:
    """The (3, 3) pinhole matrix once an image of ``size`` (width, height) is resized; corners stay corners."""
    x, y = new_size[0] / size[0], new_size[1] / size[1]
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]]) @ np.asarray(intrinsics, np.float64)


def check_intrinsics(intrinsics: ArrayLike, size: tuple[int, int]) -> None:
    """Refuse a matrix that cannot be the camera of an image of ``size`` (width, height).

    Raises:
        InputError: where it is not a pinhole matrix, its centre lies outside of the image, or the image would be
            less than 6 or more than 160 degrees wide.
    """
    matrix = np.asarray(intrinsics, np.float64)
    fits = matrix.shape == (3, 3) and np.isfinite(matrix).all() and np.abs(matrix[2] - (0, 0, 1)).max() < 1e-8
    if fits:
        focal, center = np.diag(matrix)[:2] / size[0], matrix[:2, 2] / size
        fits = bool((focal > 0.09).all() and (focal < 10).all() and (center > 0).all() and (center < 1).all())
    if not fits:
        numbers = np.array2string(matrix, precision=1, separator=" ").replace("\n", "")
        raise InputError(
            f"intrinsics {numbers}: cannot be the camera of an image of {size[0]}x{size[1]}; give fx, fy, cx and cy "
            "in pixels of that image"
        )


def normalized(pixels: ArrayLike, intrinsics: ArrayLike) -> Floats:
    """Pixels (..., 2) to where their rays meet the plane at depth 1, (..., 2)."""
    inverse = np.linalg.inv(np.asarray(intrinsics, np.float64))
    return np.asarray(pixels, np.float64) @ inverse[:2, :2].T + inverse[:2, 2]


def quantized(descriptors: ArrayLike) -> NDArray[np.uint8]:
    """Unit descriptors as bytes; (..., 128) -> (..., 128)."""
    return np.clip(np.rint(np.asarray(descriptors) * DESCRIPTOR_SCALE), 0, 255).astype(np.uint8)


def dequantized(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The unit descriptors that bytes stand for; (..., 128) -> (..., 128)."""
    floats = descriptors.astype(np.float32)
    return floats / np.maximum(np.linalg.norm(floats, axis=-1, keepdims=True), 1)


def distance(similarity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Euclidean distance of unit vectors from their product."""
    return np.sqrt(np.maximum(2 - 2 * similarity, 0))


def unambiguous(similarity_NM: NDArray[np.float32], ratio: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Each row's best column, and whether it is clearly nearer than the second best (Lowe's ratio test).

    Args:
        similarity_NM: products of unit descriptors.
        ratio: of the two distances, below which the best counts.

    Returns:
        Columns (N,) and whether each counts (N,); none does where there are fewer than two columns.
    """
    rows = np.arange(len(similarity_NM))
    if similarity_NM.shape[1] < 2:
        return np.zeros(len(rows), np.int64), np.zeros(len(rows), bool)
    best = similarity_NM.argmax(axis=1)
    first = similarity_NM[rows, best]
    similarity_NM[rows, best] = -1  # rather than a copy of what may be large
    second = similarity_NM.max(axis=1)
    similarity_NM[rows, best] = first
    return best, distance(first) < ratio * distance(second)


def mutual(similarity_NM: NDArray[np.float32], best_N: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each row is also the best of its best column, (N,)."""
    if not similarity_NM.size:
        return np.zeros(len(best_N), bool)
    column_max_M = similarity_NM.max(axis=0)  # argmax along columns takes six times as long
    return np.asarray(similarity_NM[np.arange(len(best_N)), best_N] >= column_max_M[best_N])
