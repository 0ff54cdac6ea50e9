"""Windows and doors, as pieces that stand against a wall."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from mambaloc.rendering.furniture import Piece, timber_color
from mambaloc.rendering.posters import lettered, view, word
from mambaloc.rendering.quads import box, placed, quad
from mambaloc.rendering.textures import Paint, cloth, plain, wood


def window(paint: Paint) -> Piece:
    """A window that gives light, over a radiator."""
    width, top = paint.rng.uniform(0.9, 1.4), 2.05
    pane = view(paint, width, 1.1)
    h, w = pane.shape[:2]
    bar = paint.px(0.05)
    for x in np.linspace(0, w, int(paint.rng.integers(2, 4)) + 1):
        cv2.line(pane, (round(x), 0), (round(x), h), (246, 244, 240), bar)
    cv2.rectangle(pane, (0, 0), (w, h), (246, 244, 240), 2 * bar)
    enamel = partial(plain, paint, color=paint.color(0.15, 0.85))
    ribs = enamel(width, 0.55)
    ribs[:, :: paint.px(0.06)] = ribs[:, :: paint.px(0.06)] // 2
    quads = box((0, -0.12, 0.14), (width, -0.03, 0.69), enamel, front=ribs)
    timber = partial(wood, paint, color=timber_color(paint))
    quads += box((-0.04, -0.2, top - 1.14), (width + 0.04, 0, top - 1.1), timber)
    quads.append(quad((0, -0.015, top), (width, 0, 0), (0, 0, -1.1), pane, glows=True))
    curtain = partial(cloth, paint, color=paint.color(0.5, 0.7))
    for x in (-0.06, width - paint.rng.uniform(0.05, 0.3)):
        quads += box((x, -0.1, 0.8), (x + paint.rng.uniform(0.12, 0.3), -0.03, top + 0.05), curtain)
    return Piece(width + 0.2, 0.2, top + 0.05, placed(quads, (0.1, 0, 0)))


def door(paint: Paint) -> Piece:
    """A panelled door with a handle and a sign."""
    width, height = 0.9, 2.02
    leaf = wood(paint, width, height, paint.rng.choice([timber_color(paint), paint.color(0.3, 0.8)]), 0.5)
    h, w = leaf.shape[:2]
    for bottom, top in ((0.08, 0.45), (0.52, 0.93)):
        for left in (0.12, 0.54):
            corners = (round(left * w), round((1 - top) * h)), (round((left + 0.34) * w), round((1 - bottom) * h))
            cv2.rectangle(leaf, *corners, (40, 32, 28), paint.px(0.012))
    cv2.rectangle(leaf, (0, 0), (w - 1, h), (226, 220, 208), 2 * paint.px(0.05))
    cv2.circle(leaf, (round(0.9 * w), round(0.52 * h)), paint.px(0.03), (230, 210, 120), cv2.FILLED, cv2.LINE_AA)
    sign = plain(paint, 0.3, 0.12, paint.color(0.7, 0.8))
    lettered(paint, sign, word(paint), (0.5, 0.5), 0.5)
    y, x = round(0.28 * h), (w - sign.shape[1]) // 2
    leaf[y : y + len(sign), x : x + sign.shape[1]] = sign
    return Piece(width, 0.05, height, [quad((0, -0.01, height), (width, 0, 0), (0, 0, -height), leaf)])
