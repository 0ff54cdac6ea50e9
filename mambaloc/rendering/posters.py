"""Images to hang on a wall, each painted once and never again: no two places of a room look alike."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from mambaloc.rendering.quads import Image
from mambaloc.rendering.textures import Color, Paint, darker, mixed, scaled

_WORDS = """
    ORBIT NORD LUMEN FJORD KIOSK ATLAS DELTA PRISM TANGO MOSAIC SIERRA VERTIGO HARBOUR QUARTZ JAZZ ZEBRA
    EXPO POLAR MANGO TUNDRA RADIO SPHINX OPERA COMET BAZAAR LOTUS MAGMA PIXEL SAFARI WALTZ YETI CACTUS
""".split()  # noqa: SIM905 (a list of thirty strings is no easier to read)


_FILLED = (cv2.FILLED, cv2.LINE_AA)


def poster(paint: Paint, width_m: float, height_m: float, kind: int) -> Image:
    """A framed image (H, W, 3); ``kind`` picks its genre, chance the rest."""
    image = paint.canvas(width_m, height_m, paint.color(0.4, 0.8))
    art = _GENRES[kind % len(_GENRES)](paint, image)
    edge = paint.px(paint.rng.uniform(0.012, 0.03))
    height, width = art.shape[:2]
    frame = paint.color(0.4, paint.rng.choice([0.15, 0.55, 0.9]))
    cv2.rectangle(art, (0, 0), (width - 1, height - 1), (242, 240, 234), 2 * edge)
    cv2.rectangle(art, (0, 0), (width - 1, height - 1), frame, edge)
    return art


def any_genre(paint: Paint) -> int:
    """A ``kind`` of poster drawn by chance."""
    return int(paint.rng.integers(len(_GENRES)))


def lettered(paint: Paint, image: Image, words: str, center: tuple[float, float], height: float) -> None:
    """Write words into an image, ``centre`` and letter ``height`` as fractions of its width and height."""
    h, w = image.shape[:2]
    font, thickness = cv2.FONT_HERSHEY_DUPLEX, max(1, round(0.12 * height * h))
    (text_w, text_h), _ = cv2.getTextSize(words, font, 1.0, thickness)
    scale = min(height * h / text_h, 0.92 * w / text_w)
    text_w, text_h = max(1, round(scale * text_w)), max(1, round(scale * text_h))
    x, y = round(center[0] * w - text_w / 2), round(center[1] * h + text_h / 2)
    light = image[max(0, y - text_h) : max(1, y), max(0, x) : x + text_w].mean() > 120
    color = paint.color(0.8, 0.15) if light else paint.color(0.3, 1.0)
    cv2.putText(image, words, (x, y), font, scale, color, thickness, cv2.LINE_AA)


def view(paint: Paint, width_m: float, height_m: float) -> Image:
    """What is seen through a window by day: sky, far hills, near trees."""
    image = paint.canvas(width_m, height_m)
    hill = paint.color(0.35, 0.8, hue=paint.rng.uniform(0.22, 0.45))
    sky = paint.color(0.4, 0.9, hue=0.57)
    return _hills(paint, image, sky, (236, 244, 252), hill)


def word(paint: Paint) -> str:
    """A word to print large."""
    return str(paint.rng.choice(_WORDS))


def _discs(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    for _ in range(26):
        x, y, r = paint.rng.uniform((0, 0, 0.03), (w, h, 0.2))
        cv2.circle(image, (round(x), round(y)), round(r * w) + 1, paint.color(), *_FILLED)
    return image


def _shards(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    for _ in range(18):
        points = paint.rng.uniform(0, (w, h), (3, 2)) * [1.2, 1.2] - [0.1 * w, 0.1 * h]
        cv2.fillConvexPoly(image, np.round(points).astype(np.int32), paint.color(0.7, 0.75), cv2.LINE_AA)
    return image


def _landscape(paint: Paint, image: Image) -> Image:
    return _hills(paint, image, paint.color(0.6, 0.75), paint.color(0.3, 0.95), paint.color(0.5, 0.75))


def _hills(paint: Paint, image: Image, zenith: Color, horizon: Color, hill: Color) -> Image:
    h, w = image.shape[:2]
    image = mixed(zenith, horizon, np.linspace(0, 1, h, dtype=np.float32)[:, None].repeat(w, axis=1))
    sun = (round(paint.rng.uniform(0.15, 0.85) * w), round(paint.rng.uniform(0.12, 0.4) * h))
    cv2.circle(image, sun, round(0.09 * w) + 1, (255, 236, 170), *_FILLED)
    for ridge in range(4):
        rise = paint.noise((1, w), 0.35 / (1 + ridge), octaves=5)[0] * h * 0.35
        top = h * (0.4 + 0.15 * ridge) - rise + 0.1 * h
        outline = np.vstack([np.stack([np.arange(w), top], 1), [[w, h], [0, h]]])
        cv2.fillPoly(image, [np.round(outline).astype(np.int32)], darker(hill, 0.95 - 0.22 * ridge), cv2.LINE_AA)
    return image


def _bill(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    image[: int(0.55 * h)] = paint.color(0.7, paint.rng.choice([0.35, 0.8]))
    for _ in range(5):
        x, y = paint.rng.uniform((0, 0.1 * h), (w, 0.5 * h))
        axes = paint.rng.uniform(0.03, 0.25, 2) * w + 1
        ellipse = (round(x), round(y)), (round(axes[0]), round(axes[1])), paint.rng.uniform(0, 180), 0, 360
        cv2.ellipse(image, *ellipse, paint.color(0.7, 0.7), *_FILLED)
    lettered(paint, image, word(paint), (0.5, 0.66), 0.13)
    for line in np.arange(0.78, 0.95, 0.045):
        left, right = paint.rng.uniform(0.1, 0.25), paint.rng.uniform(0.6, 0.92)
        cv2.line(image, (round(left * w), round(line * h)), (round(right * w), round(line * h)), (60, 60, 66), 1)
    return image


def _blocks(paint: Paint, image: Image) -> Image:
    def split(x0: int, y0: int, x1: int, y1: int, depth: int) -> None:
        if depth == 0:
            strong = paint.rng.random() < 0.6
            image[y0:y1, x0:x1] = paint.color(0.85, 0.8) if strong else (238, 234, 222)
            cv2.rectangle(image, (x0, y0), (x1, y1), (24, 24, 28), max(1, w // 50))
            return
        share = paint.rng.uniform(0.28, 0.72)
        if (x1 - x0) > (y1 - y0):
            middle = round(x0 + share * (x1 - x0))
            split(x0, y0, middle, y1, depth - 1)
            split(middle, y0, x1, y1, depth - 1)
        else:
            middle = round(y0 + share * (y1 - y0))
            split(x0, y0, x1, middle, depth - 1)
            split(x0, middle, x1, y1, depth - 1)

    h, w = image.shape[:2]
    split(0, 0, w, h, 4)
    return image


def _rings(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    for _ in range(3):
        x, y = paint.rng.uniform(0.15, 0.85, 2) * (w, h)
        for radius in np.arange(paint.rng.uniform(0.2, 0.6), 0, -0.055):
            cv2.circle(image, (round(x), round(y)), round(radius * w) + 1, paint.color(0.65, 0.75), *_FILLED)
    return image


def _map(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    sites = paint.rng.uniform(0, (w, h), (32, 2))
    y, x = np.mgrid[:h, :w]
    x = x + 0.15 * w * (paint.noise((h, w), 0.2) - 0.5)
    nearest = np.argmin([(x - sx) ** 2 + (y - sy) ** 2 for sx, sy in sites], axis=0)
    colors = np.array([paint.color(0.4, 0.8) for _ in sites])
    image = colors[nearest].astype(np.uint8)
    for _ in range(5):
        start, end = np.round(paint.rng.uniform(0, (w, h), (2, 2))).astype(int).tolist()
        cv2.line(image, start, end, (200, 60, 50), max(1, w // 60), cv2.LINE_AA)
    return image


def _portrait(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    image = mixed(paint.color(0.5, 0.35), paint.color(0.5, 0.8), paint.noise((h, w), 0.3))
    middle = round(paint.rng.uniform(0.42, 0.58) * w)
    cv2.ellipse(image, (middle, h), (round(0.4 * w), round(0.36 * h)), 0, 0, 360, paint.color(), *_FILLED)
    skin, hair = paint.color(0.45, 0.7, hue=0.07), paint.color(0.5, 0.3)
    cv2.ellipse(image, (middle, round(0.4 * h)), (round(0.26 * w), round(0.3 * h)), 0, 0, 360, hair, *_FILLED)
    cv2.ellipse(image, (middle, round(0.44 * h)), (round(0.19 * w), round(0.23 * h)), 0, 0, 360, skin, *_FILLED)
    for side in (-1, 1):
        cv2.circle(image, (middle + side * round(0.08 * w), round(0.41 * h)), max(1, w // 40), (30, 26, 24), *_FILLED)
    lip = (middle, round(0.54 * h)), (round(0.07 * w), max(1, round(0.015 * h)))
    cv2.ellipse(image, *lip, 0, 0, 360, (150, 60, 60), *_FILLED)
    return image


def _quilt(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    rows, columns = (int(v) for v in paint.rng.integers(5, 10, 2))
    palette = np.array([paint.color(0.7, 0.7) for _ in range(6)])
    cells = palette[paint.rng.integers(6, size=(rows, columns))].astype(np.uint8)
    return cv2.resize(cells, (w, h), interpolation=cv2.INTER_NEAREST)


def _waves(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    field = paint.noise((h, w), 0.3, octaves=2) * paint.rng.uniform(14, 26)
    return mixed(paint.color(0.8, 0.3), paint.color(0.5, 0.95), (0.5 + 0.5 * np.sin(field)).astype(np.float32))


def _skyline(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    dusk = np.linspace(0, 1, h, dtype=np.float32)[:, None].repeat(w, axis=1)
    image = mixed((24, 26, 66), paint.color(0.7, 0.85), dusk)
    left = 0
    while left < w:
        width, top = round(paint.rng.uniform(0.06, 0.2) * w) + 3, round(paint.rng.uniform(0.15, 0.7) * h)
        facade = darker((70, 74, 96), paint.rng.uniform(0.4, 1))
        cv2.rectangle(image, (left, top), (left + width, h), facade, cv2.FILLED)
        for x in range(left + 2, left + width - 2, 5):
            for y in range(top + 3, h - 3, 6):
                if paint.rng.random() < 0.45:
                    image[y : y + 3, x : x + 2] = (255, 216, 120)
        left += width
    return image


def _initial(paint: Paint, image: Image) -> Image:
    image[:, : round(paint.rng.uniform(0.3, 0.7) * image.shape[1])] = paint.color(0.8, 0.6)
    lettered(paint, image, str(paint.rng.choice(list("ABEFGKMRS23456789&?"))), (0.5, 0.45), 0.62)
    lettered(paint, image, word(paint), (0.5, 0.9), 0.08)
    return image


def _chart(paint: Paint, image: Image) -> Image:
    h, w = image.shape[:2]
    image = scaled(image, 0) + np.uint8(244)
    bars = int(paint.rng.integers(5, 10))
    for k in range(bars):
        x0, x1 = round((0.1 + 0.8 * k / bars) * w), round((0.1 + 0.8 * (k + 0.75) / bars) * w)
        top = round(paint.rng.uniform(0.2, 0.8) * h)
        cv2.rectangle(image, (x0, top), (x1, round(0.88 * h)), paint.color(0.75, 0.75), cv2.FILLED)
    lettered(paint, image, word(paint), (0.5, 0.11), 0.07)
    return image


_GENRES: tuple[Callable[[Paint, Image], Image], ...] = (
    _landscape, _bill, _blocks, _discs, _portrait, _map, _initial, _skyline, _rings, _shards, _waves, _quilt, _chart,
)  # fmt: skip
