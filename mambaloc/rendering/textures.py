"""Surfaces painted by chance: wood, brick, wallpaper, cloth and the like."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mambaloc.rendering.quads import Image

Color = tuple[float, float, float]
Field = NDArray[np.float32]


@dataclass(frozen=True)
class Paint:
    """What every painter needs: its source of chance and how many texels go to a metre."""

    rng: np.random.Generator
    px_per_m: float

    def px(self, length_m: float) -> int:
        """A length in texels, at least 1."""
        return max(1, round(length_m * self.px_per_m))

    def canvas(self, width_m: float, height_m: float, color: ArrayLike = (0, 0, 0)) -> Image:
        """An image (H, W, 3) of one colour, at least 4 texels wide and high."""
        shape = (max(4, self.px(height_m)), max(4, self.px(width_m)), 3)
        return np.full(shape, color).astype(np.uint8)

    def color(self, saturation: float = 0.6, value: float = 0.7, hue: float | None = None) -> Color:
        """A colour of any hue near a given saturation and value, RGB 0..255."""
        h, ds, dv = self.rng.uniform((0, -0.12, -0.12), (1, 0.12, 0.12))
        s, v = np.clip([saturation + ds, value + dv], 0, 1)
        r, g, b = colorsys.hsv_to_rgb(h if hue is None else hue, s, v)
        return (255 * r, 255 * g, 255 * b)

    def noise(self, shape: tuple[int, int], cell_m: float, stretch: float = 1.0, octaves: int = 4) -> Field:
        """Fractal noise (H, W) in 0..1; the largest spots are ``cell_m`` high and ``stretch`` times as wide."""
        height, width = shape
        total, weight = np.zeros(shape, dtype=np.float32), 0.0
        for octave in range(octaves):
            cell_px = max(1.0, cell_m * self.px_per_m / 2**octave)
            grid = self.rng.random((int(height / cell_px) + 4, int(width / (cell_px * stretch)) + 4), dtype=np.float32)
            step = np.array([[1 / (cell_px * stretch), 0, 1], [0, 1 / cell_px, 1]])
            flags = cv2.WARP_INVERSE_MAP | (cv2.INTER_CUBIC if octave < 2 else cv2.INTER_LINEAR)
            total += cv2.warpAffine(grid, step, (width, height), flags=flags) / 2**octave
            weight += 1 / 2**octave
        return np.clip((total / weight - 0.5) * 1.6 + 0.5, 0, 1)


def mixed(low: ArrayLike, high: ArrayLike, share: Field) -> Image:
    """The image (H, W, 3) that goes from one colour (or image) to another as ``share`` goes from 0 to 1."""
    low, high = np.asarray(low, dtype=np.float32), np.asarray(high, dtype=np.float32)
    return np.clip(low + (high - low) * share[..., None], 0, 255).astype(np.uint8)


def scaled(image: Image, factor: ArrayLike) -> Image:
    """The image with its brightness multiplied by a number or a field (H, W)."""
    factor = np.asarray(factor, dtype=np.float32)
    return np.clip(image * (factor[..., None] if factor.ndim == 2 else factor), 0, 255).astype(np.uint8)


def darker(color: Color, factor: float) -> Color:
    """The colour with its brightness multiplied by ``factor``."""
    r, g, b = (min(255.0, factor * channel) for channel in color)
    return (r, g, b)


def wood(paint: Paint, width_m: float, height_m: float, color: Color, plank_m: float = 0.14) -> Image:
    """Planks along the width, each with its own tone and grain."""
    image = paint.canvas(width_m, height_m)
    height, width = image.shape[:2]
    tone = np.ones((height, width), dtype=np.float32)
    plank = paint.px(plank_m)
    for top in range(0, height, plank):
        left = -int(paint.rng.integers(0, paint.px(1.2)))
        while left < width:
            right = left + int(paint.rng.uniform(0.8, 1.6) * paint.px(1.0))
            tone[top : top + plank, max(0, left) : right] = paint.rng.uniform(0.78, 1.12)
            tone[top : top + plank, max(0, right - 1) : right + 1] = 0.45
            left = right
        tone[top : top + 1] = 0.5
    grain = 0.62 + 0.55 * paint.noise((height, width), 0.03, stretch=14)
    return scaled(paint.canvas(width_m, height_m, color), tone * grain)


def plain(paint: Paint, width_m: float, height_m: float, color: Color, rough: float = 0.12) -> Image:
    """Paint or laminate: one colour, a little uneven, its edges worn lighter."""
    image = paint.canvas(width_m, height_m, color)
    uneven = 1 - rough / 2 + rough * paint.noise(image.shape[:2], 0.15)
    height, width = image.shape[:2]
    image = scaled(image, uneven)
    edge = tuple(int(min(255, 1.15 * c + 12)) for c in color)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), edge, 1)
    return image


def cloth(paint: Paint, width_m: float, height_m: float, color: Color) -> Image:
    """Woven cloth with a coarse random check."""
    image = paint.canvas(width_m, height_m, color)
    height, width = image.shape[:2]
    weave = paint.rng.uniform(0.9, 1.1, (height, width)).astype(np.float32)
    pitch = paint.px(paint.rng.uniform(0.05, 0.12))
    for axis in (0, 1):
        stripes = (np.arange((height, width)[axis]) // pitch % paint.rng.integers(2, 5) == 0) * 0.18
        weave -= stripes[:, None] if axis == 0 else stripes[None, :]
    return scaled(image, weave * (0.8 + 0.4 * paint.noise((height, width), 0.3)))


def brick(paint: Paint, width_m: float, height_m: float) -> Image:
    """A brick wall in running bond, some bricks burnt darker."""
    base = paint.color(0.5, 0.62, hue=paint.rng.uniform(0.01, 0.06))
    image = paint.canvas(width_m, height_m, (196, 188, 176))
    height, width = image.shape[:2]
    course, length, joint = paint.px(0.085), paint.px(0.25), max(1, paint.px(0.011))
    for row, top in enumerate(range(0, height, course)):
        for left in range(-(row % 2) * length // 2, width, length):
            color = darker(base, paint.rng.choice([0.62, 1.0, 1.0, 1.0, 1.22]) * paint.rng.uniform(0.85, 1.12))
            x1, y1 = left + length - joint - 1, top + course - joint - 1
            cv2.rectangle(image, (max(0, left), top), (x1, y1), color, cv2.FILLED)
    return scaled(image, 0.72 + 0.5 * paint.noise((height, width), 0.4, octaves=6))


def wallpaper(paint: Paint, width_m: float, height_m: float) -> Image:
    """Striped wallpaper with flowers strewn at random, no two strips alike."""
    base = paint.color(0.16, 0.88)
    image = paint.canvas(width_m, height_m, base)
    height, width = image.shape[:2]
    for left in range(0, width, paint.px(0.36)):
        color = darker(base, paint.rng.uniform(0.82, 1.08))
        cv2.rectangle(image, (left, 0), (left + paint.px(paint.rng.uniform(0.08, 0.26)), height), color, cv2.FILLED)
    petals = [paint.color(0.5, 0.62) for _ in range(4)]
    for _ in range(int(9 * width_m * height_m)):
        x, y = (int(v) for v in paint.rng.integers(0, (width, height)))
        size, count, angle = paint.px(paint.rng.uniform(0.02, 0.045)), paint.rng.integers(4, 8), paint.rng.uniform(0, 6)
        petal = petals[paint.rng.integers(len(petals))]
        for k in range(count):
            turn = angle + 2 * np.pi * k / count
            center = (round(x + size * np.cos(turn)), round(y + size * np.sin(turn)))
            cv2.circle(image, center, max(1, round(0.6 * size)), petal, cv2.FILLED, cv2.LINE_AA)
        cv2.circle(image, (x, y), max(1, size // 2), (236, 220, 130), cv2.FILLED, cv2.LINE_AA)
    return scaled(image, 0.9 + 0.2 * paint.noise((height, width), 0.8))


def plaster(paint: Paint, width_m: float, height_m: float, color: Color | None = None) -> Image:
    """Old plaster: cloudy, with damp stains and cracks."""
    base = color or paint.color(0.18, 0.84)
    image = paint.canvas(width_m, height_m)
    height, width = image.shape[:2]
    image = mixed(darker(base, 0.78), darker(base, 1.1), paint.noise((height, width), 0.7, octaves=6))
    damp = np.clip(paint.noise((height, width), 1.1, octaves=5) * 3 - 1.9, 0, 1)
    image = mixed(image, (128, 112, 84), 0.45 * damp * (0.5 + 0.5 * (damp < 0.9)))
    for _ in range(int(2 + 0.5 * width_m * height_m)):
        start = paint.rng.uniform(0, (width, height))
        steps = paint.rng.normal(paint.rng.normal(0, 1, 2), 0.8, (14, 2)) * paint.px(0.035)
        crack = np.round(start + np.cumsum(steps, axis=0)).astype(np.int32)
        cv2.polylines(image, [crack], False, darker(base, 0.55), 1, cv2.LINE_AA)
    return image


def panelling(paint: Paint, width_m: float, height_m: float) -> Image:
    """A painted wall above panels of wood as high as a table."""
    image = plaster(paint, width_m, height_m, paint.color(0.35, 0.78))
    height, width = image.shape[:2]
    top = max(0, height - paint.px(1.05))
    oak = paint.color(0.5, 0.55, hue=paint.rng.uniform(0.06, 0.1))
    boards = wood(paint, 1.05, width_m, oak, plank_m=0.6).transpose(1, 0, 2)
    image[top:] = cv2.resize(boards, (width, height - top), interpolation=cv2.INTER_AREA)
    rail, step = paint.px(0.04), paint.px(0.6)
    cv2.rectangle(image, (0, top), (width, top + rail), darker(oak, 1.25), cv2.FILLED)
    for left in range(0, width, step):
        inset = paint.px(0.07)
        x0, y0, x1, y1 = left + inset, top + rail + inset, left + step - inset, height - 2 * inset
        groove = paint.px(0.012)
        cv2.rectangle(image, (x0, y0), (x1, y1), darker(oak, 0.5), groove)
        cv2.rectangle(image, (x0 + groove, y0 + groove), (x1 + groove, y1 + groove), darker(oak, 1.3), 1)
    return image


def tiles(paint: Paint, width_m: float, height_m: float, tile_m: float, colors: list[Color]) -> Image:
    """Square tiles in colours drawn at random, with grey joints."""
    size = (int(height_m / tile_m) + 1, int(width_m / tile_m) + 1)
    picks = np.asarray(colors)[paint.rng.integers(len(colors), size=size)] * paint.rng.uniform(0.9, 1.1, (*size, 1))
    tile = max(2, paint.px(tile_m))
    height, width = paint.canvas(width_m, height_m).shape[:2]
    rows, columns = np.arange(height) // tile, np.arange(width) // tile
    image = np.clip(picks, 0, 255).astype(np.uint8)[rows[:, None] % size[0], columns % size[1]]
    image[::tile], image[:, ::tile] = 150, 150
    return scaled(image, 0.88 + 0.24 * paint.noise(image.shape[:2], 0.5))
