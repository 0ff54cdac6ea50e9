"""Furniture made of boxes, each piece drawn at random.

A piece stands in a frame of its own: ``x`` to the right along the wall behind it from 0 to its width, ``y`` into
that wall, which is at 0, ``z`` up from the floor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mambaloc.rendering.posters import any_genre, lettered, poster, word
from mambaloc.rendering.quads import Image, Quad, box, placed, quad
from mambaloc.rendering.textures import Color, Paint, cloth, darker, plain, scaled, wood


@dataclass(frozen=True)
class Piece:
    """A piece of furniture: its quads and the wall it covers, metres. ``depth_m`` is how far it reaches."""

    width_m: float
    depth_m: float
    height_m: float
    quads: Sequence[Quad]


def bookcase(paint: Paint) -> Piece:
    """Open shelves full of books, none like another."""
    width, height, depth = paint.rng.uniform(0.8, 1.3), paint.rng.uniform(1.5, 2.1), 0.32
    timber = timber_color(paint)
    front = _shelves_of_books(paint, width, height, timber)
    body = box((0, -depth, 0), (width, 0, height), partial(wood, paint, color=timber), front=front)
    return Piece(width, depth, height, body + _clutter(paint, 0, width, -depth / 2, height, 2))


def chest(paint: Paint) -> Piece:
    """A chest of drawers with things on it."""
    width, height, depth = paint.rng.uniform(0.8, 1.2), paint.rng.uniform(0.75, 1.0), 0.45
    timber = timber_color(paint)
    front = _fronts(paint, wood(paint, width, height, timber, 0.5), int(paint.rng.integers(3, 5)), 2)
    body = box((0, -depth, 0), (width, 0, height), partial(wood, paint, color=timber), front=front)
    return Piece(width, depth, height, body + _clutter(paint, 0, width, -depth / 2, height, 4))


def wardrobe(paint: Paint) -> Piece:
    """A tall cupboard, its doors pasted over with images."""
    width, height, depth = paint.rng.uniform(1.0, 1.4), paint.rng.uniform(1.8, 2.1), 0.58
    timber, doors = timber_color(paint), int(paint.rng.integers(2, 4))
    front = _fronts(paint, wood(paint, height, width, timber, 0.2).transpose(1, 0, 2).copy(), 1, doors)
    for k in range(doors):
        for middle in (0.25, 0.6):
            w, h = paint.rng.uniform((0.16, 0.2), (0.8 * width / doors, 0.55))
            painting = poster(paint, w, h, any_genre(paint))
            _paste(front, painting, ((k + 0.46) / doors, middle + paint.rng.uniform(-0.05, 0.05)))
    body = box((0, -depth, 0), (width, 0, height), partial(wood, paint, color=timber), front=front)
    return Piece(width, depth, height, body + _clutter(paint, 0, width, -depth / 2, height, 2))


def kitchen(paint: Paint) -> Piece:
    """A counter with doors, a tiled top, an oven and pots."""
    width, height, depth = paint.rng.uniform(1.5, 1.9), 0.9, 0.6
    color, stone = paint.color(0.5, 0.75), paint.color(0.1, 0.45)
    front = _fronts(paint, plain(paint, width, height, color), 1, 4)
    h, w = front.shape[:2]
    for left, top, right, bottom, shade in (
        (0.26, 0.12, 0.49, 0.9, (36, 36, 40)),
        (0.29, 0.35, 0.46, 0.8, (120, 70, 40)),
    ):
        corners = (round(left * w), round(top * h)), (round(right * w), round(bottom * h))
        cv2.rectangle(front, *corners, shade, cv2.FILLED)
    for k in range(4):
        knob = (round((0.29 + 0.055 * k) * w), round(0.2 * h))
        cv2.circle(front, knob, max(1, w // 80), (220, 220, 220), cv2.FILLED, cv2.LINE_AA)
    body = box((0, -depth, 0), (width, 0, height), partial(plain, paint, color=color), front=front)
    slab = partial(plain, paint, color=stone, rough=0.6)
    counter = box((0, -depth - 0.03, height), (width, 0, height + 0.04), slab, omit=("back",))
    return Piece(width, depth, height + 0.04, body + counter + _clutter(paint, 0, width, -0.3, height + 0.04, 5))


def fridge(paint: Paint) -> Piece:
    """A fridge stuck over with notes."""
    width, height, depth = 0.62, paint.rng.uniform(1.6, 1.85), 0.6
    color = paint.color(0.2, 0.88)
    front = _fronts(paint, plain(paint, width, height, color, 0.05), 1, 1)
    h, w = front.shape[:2]
    cv2.line(front, (0, round(0.34 * h)), (w, round(0.34 * h)), darker(color, 0.4), max(1, h // 100))
    for _ in range(9):
        width_m, height_m = paint.rng.uniform(0.08, 0.2, 2)
        note = poster(paint, width_m, height_m, any_genre(paint))
        _paste(front, note, paint.rng.uniform(0.2, 0.8, 2))
    body = box((0, -depth, 0), (width, 0, height), partial(plain, paint, color=color), front=front)
    return Piece(width, depth, height, body)


def sofa(paint: Paint) -> Piece:
    """A sofa with cushions of other cloths."""
    width, depth = paint.rng.uniform(1.5, 2.0), 0.8
    color = paint.color(0.55, 0.6)
    cover = partial(cloth, paint, color=color)
    quads = box((0, -depth, 0.08), (width, 0, 0.42), cover) + box((0, -0.22, 0.42), (width, 0, 0.85), cover)
    for x in (0, width - 0.16):
        quads += box((x, -depth, 0.42), (x + 0.16, -0.22, 0.62), cover)
    for k in range(int(paint.rng.integers(2, 5))):
        cushion = partial(cloth, paint, color=paint.color(0.7, 0.75))
        pillow = box((-0.2, -0.14, 0), (0.2, 0, 0.36), cushion, omit=("bottom",))
        quads += placed(pillow, (0.4 + 0.38 * k, -0.26, 0.43), paint.rng.uniform(-0.3, 0.3))
    return Piece(width, depth, 0.85, quads)


def desk(paint: Paint) -> Piece:
    """A desk with a screen, papers and a chair."""
    width, depth, height = paint.rng.uniform(1.2, 1.6), 0.65, 0.74
    timber, steel = timber_color(paint), paint.color(0.2, 0.3)
    quads = box((0, -depth, height - 0.04), (width, 0, height), partial(wood, paint, color=timber), omit=("back",))
    for x in (0.02, width - 0.06):
        quads += box((x, -depth + 0.03, 0), (x + 0.04, -0.03, height - 0.04), partial(plain, paint, color=steel))
    x = paint.rng.uniform(0.1, width - 0.7)
    screen = poster(paint, 0.56, 0.34, any_genre(paint))
    dark = partial(plain, paint, color=(30, 30, 34))
    quads += box((x, -0.3, height + 0.1), (x + 0.56, -0.26, height + 0.44), dark, front=screen)
    quads += box((x + 0.22, -0.32, height), (x + 0.34, -0.22, height + 0.1), dark)
    quads += _clutter(paint, 0.05, width - 0.05, -0.45, height, 4)
    quads += placed(_chair(paint), (width * paint.rng.uniform(0.35, 0.65), -0.72, 0), paint.rng.uniform(-0.5, 0.5))
    return Piece(width, depth + 0.3, height + 0.45, quads)


def plant(paint: Paint) -> Piece:
    """A pot with a fan of leaves."""
    pot = partial(plain, paint, color=paint.color(0.6, 0.6))
    quads = box((0.1, -0.42, 0), (0.42, -0.1, 0.36), pot, top=plain(paint, 0.3, 0.3, (60, 44, 32)))
    hue = paint.rng.uniform(0.22, 0.4)
    for _ in range(18):
        azimuth, rise = paint.rng.uniform(0, 2 * np.pi), paint.rng.uniform(0.5, 1.4)
        stem = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
        across = np.cross(stem, paint.rng.normal(size=3))
        across *= paint.rng.uniform(0.05, 0.09) / np.linalg.norm(across)
        base = np.array([0.26, -0.26, 0.36]) + stem * paint.rng.uniform(0.05, 0.4)
        length = stem * paint.rng.uniform(0.2, 0.36)
        leaf = scaled(plain(paint, 0.1, 0.2, paint.color(0.65, 0.5, hue=hue)), paint.rng.uniform(0.7, 1.2))
        quads.append(quad(base, across + length / 2, length / 2 - across, leaf))
        quads.append(quad(base, length / 2 - across, across + length / 2, leaf))
    return Piece(0.52, 0.52, 1.15, quads)


def crates(paint: Paint) -> Piece:
    """A stack of labelled boxes, none quite straight."""
    quads: list[Quad] = []
    top = 0.0
    for _ in range(int(paint.rng.integers(3, 5))):
        w, d, h = paint.rng.uniform((0.4, 0.3, 0.2), (0.6, 0.42, 0.38))
        hue = paint.rng.choice([0.08, 0.1, 0.55])
        card = partial(plain, paint, color=paint.color(0.45, 0.65, hue), rough=0.4)
        label = card(w, h)
        lettered(paint, label, word(paint), (0.5, 0.5), paint.rng.uniform(0.2, 0.4))
        body = box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), card, omit=("bottom",), front=label)
        quads += placed(body, (0.36 + paint.rng.uniform(-0.04, 0.04), -0.32, top), paint.rng.uniform(-0.25, 0.25))
        top += h
    return Piece(0.72, 0.6, top, quads)


def sideboard(paint: Paint) -> Piece:
    """A low board with a television."""
    width, height, depth = paint.rng.uniform(1.3, 1.7), 0.5, 0.42
    timber = timber_color(paint)
    front = _fronts(paint, wood(paint, width, height, timber, 0.5), 1, 3)
    quads = box((0, -depth, 0), (width, 0, height), partial(wood, paint, color=timber), front=front)
    show = poster(paint, 0.96, 0.54, any_genre(paint))
    dark = partial(plain, paint, color=(26, 26, 30))
    quads += box((0.1, -0.24, height + 0.04), (1.06, -0.2, height + 0.58), dark, front=show)
    quads += box((0.4, -0.3, height), (0.76, -0.16, height + 0.04), dark)
    return Piece(width, depth, height + 0.6, quads + _clutter(paint, 1.1, width, -0.2, height, 2))


def low_table(paint: Paint) -> Piece:
    """A coffee table for the middle of the room, centred on the origin of its frame."""
    timber = timber_color(paint)
    quads = box((-0.5, -0.3, 0.36), (0.5, 0.3, 0.41), partial(wood, paint, color=timber), omit=())
    for x in (-0.46, 0.4):
        for y in (-0.26, 0.2):
            leg = partial(wood, paint, color=timber)
            quads += box((x, y, 0), (x + 0.06, y + 0.06, 0.36), leg, omit=("bottom", "top"))
    return Piece(1.0, 0.6, 0.41, quads + _clutter(paint, -0.45, 0.45, 0, 0.41, 5))


PIECES: tuple[Callable[[Paint], Piece], ...] = (
    bookcase, desk, sofa, kitchen, plant, wardrobe, chest, fridge, sideboard, crates,
)  # fmt: skip


def timber_color(paint: Paint) -> Color:
    """A brown between pine and walnut."""
    return paint.color(0.5, paint.rng.choice([0.4, 0.6, 0.78]), hue=paint.rng.uniform(0.05, 0.1))


def _chair(paint: Paint) -> list[Quad]:
    seat = partial(cloth, paint, color=paint.color(0.7, 0.6))
    leg = partial(plain, paint, color=(50, 50, 54))
    quads = box((-0.22, -0.22, 0.42), (0.22, 0.22, 0.48), seat, omit=())
    quads += box((-0.2, -0.22, 0.55), (0.2, -0.18, 0.92), seat, omit=())
    for x, y in ((-0.2, -0.2), (0.16, -0.2), (-0.2, 0.16), (0.16, 0.16)):
        quads += box((x, y, 0), (x + 0.04, y + 0.04, 0.55 if y < 0 else 0.42), leg, omit=("bottom", "top"))
    return quads


def _clutter(paint: Paint, left: float, right: float, y: float, z: float, count: int) -> list[Quad]:
    """Small things in a row on a board."""
    quads: list[Quad] = []
    pitch = (right - left) / count
    for k in range(count):
        size = paint.rng.uniform((0.06, 0.06, 0.06), (min(0.26, 0.8 * pitch), 0.2, 0.3))
        face = partial(plain, paint, color=paint.color(0.7, 0.7), rough=0.3)
        label = poster(paint, size[0], size[2], any_genre(paint))
        w, d, h = size
        thing = box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), face, omit=("bottom",), front=label)
        quads += placed(thing, (left + (k + 0.5) * pitch, y, z), paint.rng.uniform(-0.5, 0.5))
    return quads


def _fronts(paint: Paint, image: Image, rows: int, columns: int) -> Image:
    """Draw drawers or doors with handles on a front."""
    h, w = image.shape[:2]
    line = max(1, paint.px(0.008))
    for row in range(rows):
        for column in range(columns):
            x0, x1 = round(w * column / columns), round(w * (column + 1) / columns) - 1
            y0, y1 = round(h * row / rows), round(h * (row + 1) / rows) - 1
            image[y0:y1, x0:x1] = scaled(image[y0:y1, x0:x1], paint.rng.uniform(0.88, 1.1))
            cv2.rectangle(image, (x0, y0), (x1, y1), (40, 34, 30), line)
            x = (x0 + x1) // 2 if rows > 1 else x1 - paint.px(0.06)
            y = (y0 + y1) // 2
            dx, dy = (paint.px(0.07), 0) if rows > 1 else (0, paint.px(0.09))
            cv2.line(image, (x - dx, y - dy), (x + dx, y + dy), (214, 206, 190), 2 * line, cv2.LINE_AA)
    return image


def _paste(surface: Image, painting: Image, center: ArrayLike) -> None:
    """Stick an image that fits onto a surface, ``centre`` as fractions of its width and height."""
    (h, w), (rows, columns) = surface.shape[:2], painting.shape[:2]
    x, y = np.round(np.asarray(center) * (w, h) - np.array([columns, rows]) / 2).astype(int)
    target = surface[max(0, y) : y + rows, max(0, x) : x + columns]
    target[:] = painting[: target.shape[0], : target.shape[1]]


def _shelves_of_books(paint: Paint, width_m: float, height_m: float, timber: Color) -> Image:
    image = wood(paint, width_m, height_m, timber, 0.5)
    h, w = image.shape[:2]
    board = max(1, paint.px(0.025))
    shelves = round(height_m / 0.34)
    for row in range(shelves):
        y0, y1 = round(h * row / shelves) + board, round(h * (row + 1) / shelves)
        image[y0:y1, board : w - board] = darker(timber, 0.3)
        x = board
        while x < w - board:
            spine = max(2, paint.px(paint.rng.uniform(0.018, 0.055)))
            top = y1 - round((y1 - y0) * paint.rng.uniform(0.6, 0.95))
            if paint.rng.random() < 0.08:
                x += 3 * spine
                continue
            right = min(x + spine, w - board)
            color = paint.color(0.55, paint.rng.choice([0.3, 0.55, 0.8]))
            image[top:y1, x:right] = color
            image[top:y1, x : x + 1] = darker(color, 0.55)
            band = top + round((y1 - top) * paint.rng.uniform(0.1, 0.7))
            image[band : band + max(2, (y1 - top) // 6), x + 1 : right] = paint.color(0.3, 0.9)
            x = right
    return image
