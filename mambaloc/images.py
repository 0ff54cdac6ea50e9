"""Image files to arrays, and what a network's input has been through: decoding, resizing, cropping.

Training and the torch-free runtime both use these, so that an image looks the same to either.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError

Image = NDArray[np.uint8]
"""RGB, (H, W, 3)."""

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
"""Suffixes of files that are taken for images."""

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in grey: ITU-R BT.601, as torchvision and PIL have them."""

LARGEST_SIDE_PX = 32_766
"""Longest side of an image, and of cameras: ``cv2.remap``, which removes distortion, takes no longer one."""

CORNER_PX = 0.5
"""Column and row of the top-left pixel's centre where others count from its corner; here the centre is (0, 0)."""

END_BYTES = 4096
"""How far from a file's end its format's last marker may lie."""

_MARKERS = {b"\x89PNG": b"IEND", b"\xff\xd8\xff": b"\xff\xd9"}  # how a format starts, and how a whole file ends


def decode_image(data: bytes, upright: bool = True) -> Image | str:
    """Decode a file's bytes to RGB; or return the rule that it breaks.

    Grey becomes RGB, and an alpha channel is dropped.

    Args:
        data: of the file.
        upright: turn it as its EXIF orientation says; otherwise pixels are those that the file holds.
    """
    flags = cv2.IMREAD_COLOR if upright else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    for start, end in _MARKERS.items():
        # OpenCV fills what a truncated file lacks with grey and says nothing.
        if data.startswith(start) and end not in data[-END_BYTES:]:
            return "image is truncated"
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:  # a damaged header that asks for more than 2^30 pixels
        image = None
    if image is None:
        return "image cannot be decoded"
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)  # type: ignore[return-value]


def read_image(path: str | Path) -> Image:
    """Read an image file as RGB, upright.

    Raises:
        InputError: where it is missing or no whole image.
    """
    try:
        image = decode_image(Path(path).read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a picture") from None
    if isinstance(image, str):
        raise InputError(f"{path}: {image}; give a whole JPEG or PNG")
    return image


def as_rgb(image: Image) -> Image:
    """Check an array and make grey or RGBA RGB; (H, W), (H, W, 3) or (H, W, 4) -> (H, W, 3).

    Raises:
        InputError: for anything else.
    """
    image = np.asarray(image)
    channels = {2: 1, 3: image.shape[-1]}.get(image.ndim)
    if image.dtype != np.uint8 or channels not in (1, 3, 4) or 0 in image.shape:
        raise InputError(f"image array {image.dtype} {image.shape}: give uint8 RGB (H, W, 3) or grey (H, W)")
    if image.ndim == 2:
        image = image[..., None]
    return np.repeat(image, 3, axis=-1) if channels == 1 else image[..., :3]


def resized_size(size: tuple[int, int], short_side: int) -> tuple[int, int]:
    """(height, width) of an image once its shorter side has so many pixels."""
    scale = short_side / min(size)
    return round(size[0] * scale), round(size[1] * scale)


def resized(image: Image, short_side: int) -> Image:
    """Resize so that the shorter side has so many pixels, averaging areas where that is smaller."""
    height, width = resized_size(image.shape[:2], short_side)
    how = cv2.INTER_AREA if height < image.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=how)  # type: ignore[return-value]


def center_corner(size: Sequence[int], crop: tuple[int, int]) -> tuple[int, int]:
    """(row, column) of the top-left pixel of the middle crop, both sizes (height, width)."""
    return (size[0] - crop[0]) // 2, (size[1] - crop[1]) // 2


def center_cropped(image: Image, crop: tuple[int, int]) -> Image:
    """Take the middle (height, width) of an image, black where the image is smaller."""
    top, left = center_corner(image.shape[:2], crop)
    inside = image[max(top, 0) : top + crop[0], max(left, 0) : left + crop[1]]
    if inside.shape[:2] == crop:
        return inside
    cropped = np.zeros((*crop, *image.shape[2:]), image.dtype)
    cropped[max(-top, 0) :, max(-left, 0) :][: inside.shape[0], : inside.shape[1]] = inside
    return cropped
