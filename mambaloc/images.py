"""Image files to arrays, and what a network's input has been through: decoding, resizing, cropping.

Training and the torch-free runtime both use these, so that an image looks the same to either.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
"""RGB, (H, W, 3)."""

END_BYTES = 4096
"""How far from a file's end its format's last marker may lie."""

_MARKERS = {b"\x89PNG": b"IEND", b"\xff\xd8\xff": b"\xff\xd9"}  # how a format starts, and how a whole file ends


def decode_image(data: bytes) -> Image | str:
    """Decode a file's bytes to RGB, upright by its EXIF orientation; or return the rule that it breaks.

    Grey becomes RGB, and an alpha channel is dropped.
    """
    for start, end in _MARKERS.items():
        # OpenCV fills what a truncated file lacks with grey and says nothing.
        if data.startswith(start) and end not in data[-END_BYTES:]:
            return "image is truncated"
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    except cv2.error:  # a damaged header that asks for more than 2^30 pixels
        image = None
    if image is None:
        return "image cannot be decoded"
    return image[..., ::-1]  # type: ignore[return-value]


def resized_size(size: tuple[int, int], short_side: int) -> tuple[int, int]:
    """(height, width) of an image once its shorter side has so many pixels."""
    scale = short_side / min(size)
    return round(size[0] * scale), round(size[1] * scale)


def resized(image: Image, short_side: int) -> Image:
    """Resize so that the shorter side has so many pixels, averaging areas where that is smaller."""
    height, width = resized_size(image.shape[:2], short_side)
    how = cv2.INTER_AREA if height < image.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=how)  # type: ignore[return-value]


def center_cropped(image: Image, crop: tuple[int, int]) -> Image:
    """Take the middle (height, width) of an image."""
    top, left = (image.shape[0] - crop[0]) // 2, (image.shape[1] - crop[1]) // 2
    return image[top : top + crop[0], left : left + crop[1]]
