"""Images made worse: motion blur, darkness, things in front, a smaller sensor."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from mambaloc.images import Image

Disturbance = Callable[[Image, np.random.Generator], Image]

_BLUR_WIDTH_PX = 640  # of the image in which lengths of motion blur are given
_NOISE = 3.0  # standard deviation of a dark image's noise, of 255
_SIDES = (0.2, 0.45)  # of rectangles in front, over the image's
_TEXTURE_PX = 8  # sides of the squares of a textured rectangle


def undisturbed(image: Image, rng: np.random.Generator) -> Image:
    """The image as it is stored."""
    return image


def motion_blur(image: Image, rng: np.random.Generator, length_px: float) -> Image:
    """Average along a straight line, whose direction is drawn.

    Args:
        image: RGB (H, W, 3).
        rng: draws the direction.
        length_px: of the line, in pixels of an image that is 640 wide.
    """
    length_px = length_px * image.shape[1] / _BLUR_WIDTH_PX
    kernel = _line(max(length_px, 1.0), rng.uniform(0, np.pi))
    return cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REFLECT)  # type: ignore[return-value]


def _line(length_px: float, angle: float) -> np.ndarray:
    """A line through the middle of a square, whose pixels sum to 1."""
    half = int(np.ceil(length_px / 2)) + 1
    along = np.linspace(-(length_px - 1) / 2, (length_px - 1) / 2, int(8 * length_px) + 1)
    x, y = half + along * np.cos(angle), half + along * np.sin(angle)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    for down in (0, 1):
        for right in (0, 1):
            share = np.abs(1 - right - (x - left)) * np.abs(1 - down - (y - top))
            np.add.at(kernel, (top + down, left + right), share)
    return kernel / kernel.sum()


def exposure(image: Image, rng: np.random.Generator, gain: float) -> Image:
    """Multiply stored values by a gain, add normal noise of 3 of 255 to each, and round."""
    noise = rng.standard_normal(image.shape, dtype=np.float32) * np.float32(_NOISE)
    return np.clip(np.rint(image * np.float32(gain) + noise), 0, 255).astype(np.uint8)


def occlusion(image: Image, rng: np.random.Generator, share: float) -> Image:
    """Cover exactly so large a share of the pixels with rectangles, grey and textured in turns."""
    height, width = image.shape[:2]
    covered, left = image.copy(), round(share * height * width)
    free, number = np.ones((height, width), bool), 0
    while left:
        rows, columns = (max(1, round(side * rng.uniform(*_SIDES))) for side in (height, width))
        top, start = rng.integers(height - rows + 1), rng.integers(width - columns + 1)
        inside = np.zeros_like(free)
        inside[top : top + rows, start : start + columns] = True
        chosen = np.flatnonzero(inside & free)[:left]  # the last rectangle ends where enough is covered
        surface = _grey(image, rng) if number % 2 == 0 else _texture(image, rng)
        covered.reshape(-1, 3)[chosen] = surface.reshape(-1, 3)[chosen]
        free.flat[chosen] = False
        left, number = left - len(chosen), number + 1
    return covered


def _grey(image: Image, rng: np.random.Generator) -> Image:
    return np.full_like(image, rng.integers(40, 216))


def _texture(image: Image, rng: np.random.Generator) -> Image:
    height, width = image.shape[:2]
    squares = rng.integers(0, 256, (-(-height // _TEXTURE_PX), -(-width // _TEXTURE_PX), 3), dtype=np.uint8)
    return np.repeat(np.repeat(squares, _TEXTURE_PX, 0), _TEXTURE_PX, 1)[:height, :width]


def smaller(image: Image, rng: np.random.Generator, factor: int) -> Image:
    """Average squares of so many pixels a side."""
    height, width = (max(1, round(side / factor)) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


DISTURBANCES: dict[str, Disturbance] = {
    "undisturbed": undisturbed,
    "motion blur 15 px": partial(motion_blur, length_px=15),
    "motion blur 31 px": partial(motion_blur, length_px=31),
    "motion blur 61 px": partial(motion_blur, length_px=61),
    "exposure x 0.3": partial(exposure, gain=0.3),
    "exposure x 0.1": partial(exposure, gain=0.1),
    "30 % covered": partial(occlusion, share=0.3),
    "60 % covered": partial(occlusion, share=0.6),
    "a quarter of the width": partial(smaller, factor=4),
}
"""By name, in the order of tables and figures."""
