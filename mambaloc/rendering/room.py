"""Furnished rooms, sized around the places where a camera goes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mambaloc.rendering.furniture import PIECES, Piece, low_table
from mambaloc.rendering.lighting import lit
from mambaloc.rendering.openings import door, window
from mambaloc.rendering.posters import poster
from mambaloc.rendering.quads import Image, Quad, Room, Vectors, box, placed, quad
from mambaloc.rendering.textures import (
    Paint,
    brick,
    mixed,
    panelling,
    plain,
    plaster,
    tiles,
    wallpaper,
    wood,
)

MARGIN_M = 1.2  # from the camera's box to the walls: deeper than any piece of furniture
BELOW_M, ABOVE_M = 1.05, 0.9  # from the camera's box to the floor, which low tables fit under, and to the ceiling
MIN_HEIGHT_M = 2.5
_WIDEST_BOX_M = 3.5  # a larger camera box gets the room of a smaller one, scaled up


def furnished_room(inside_m: ArrayLike, seed: int, px_per_m: float = 280) -> Room:
    """A room with furniture along its walls, around a box that stays free; ``z`` is up.

    Args:
        inside_m: (2, 3) lower and upper corner of the free box, metres.
        seed: another seed is another room; the same seed gives the same bytes.
        px_per_m: how fine the textures are.
    """
    lower, upper = np.asarray(inside_m, dtype=float)
    length, width, height = upper - lower + (2 * MARGIN_M, 2 * MARGIN_M, BELOW_M + ABOVE_M)
    height = max(height, MIN_HEIGHT_M)
    paint = Paint(np.random.default_rng(seed), px_per_m)

    quads = [*_ceiling(paint, length, width, height), _floor(paint, length, width)]
    quads += placed(low_table(paint).quads, [*paint.rng.uniform(-0.25, 0.25, 2), 0], paint.rng.uniform(0, np.pi))
    styles = [brick, wallpaper, plaster, panelling]
    paint.rng.shuffle(styles)
    deck = _Deck(paint)
    # Four walls, anticlockwise from +y. In its own frame a wall runs along x from its left end, seen from y < 0.
    for turn, style in enumerate(styles):
        run, reach = (length, width) if turn % 2 == 0 else (width, length)
        corner_clearance = 0.1 if turn % 2 == 0 else 0.8  # the corners belong to the walls along x
        wall = _wall(paint, style(paint, run, height), run, height, deck, corner_clearance)
        quads += placed(placed(wall, (-run / 2, reach / 2, 0)), (0, 0, 0), turn * np.pi / 2)

    origin = np.array([*(lower + upper)[:2] / 2, lower[2] - BELOW_M])
    return Room(tuple(lit(quads)), np.stack([lower, upper]) - origin).moved(np.eye(3), origin)


def room_around(world_from_cam: ArrayLike, seed: int, px_per_m: float = 280) -> Room:
    """A room in which all of the cameras stand free, whatever the world's axes and scale.

    The room stands upright along the world axis nearest to the cameras' mean upward direction. Where the cameras
    spread over more than a few metres it is scaled up, furniture and all. Positions far outside of all others
    (wrong labels) do not count.

    Args:
        world_from_cam: (N, 4, 4) camera poses, metres.
        seed: another seed is another room.
        px_per_m: how fine the textures are, per metre of the room before it is scaled.
    """
    poses = np.asarray(world_from_cam, dtype=float)
    upright = _upright(-poses[:, :3, 1].mean(axis=0))
    positions = _without_outliers(poses[:, :3, 3]) @ upright
    lower, upper = positions.min(axis=0), positions.max(axis=0)
    scale = max(1.0, float(np.sqrt((upper - lower)[:2].prod())) / _WIDEST_BOX_M)
    room = furnished_room(np.stack([lower, upper]) / scale, seed, px_per_m)
    return room.moved(scale * upright, np.zeros(3))


class _Deck:
    """Every kind of furniture in a random order, over and over."""

    def __init__(self, paint: Paint):
        self.paint = paint
        self.posters = 0
        self.cards = self._shuffled()

    def _shuffled(self) -> list[Callable[[Paint], Piece]]:
        cards = [*PIECES, window, window, door]
        self.paint.rng.shuffle(cards)
        return cards

    def deal(self, space_m: float) -> Piece | None:
        """The next piece that is no wider than the space; None where three in a row are."""
        for k in range(3):
            if len(self.cards) <= k:
                self.cards += self._shuffled()
            piece = self.cards[k](self.paint)
            if piece.width_m <= space_m:
                del self.cards[k]
                return piece
        return None


def _wall(paint: Paint, surface: Image, run: float, height: float, deck: _Deck, clearance: float) -> list[Quad]:
    """A wall with furniture along it and images above the furniture, from (0, 0, 0) to (run, 0, height)."""
    quads: list[Quad] = []
    taken = []  # rectangles (left, bottom, right, top) of the wall that hold something
    x = clearance + paint.rng.uniform(0, 0.3)
    while (piece := deck.deal(run - clearance - x)) is not None:
        quads += placed(piece.quads, (x, 0, 0))
        taken.append((x, 0.0, x + piece.width_m, piece.height_m))
        x += piece.width_m + paint.rng.uniform(0.08, 0.5)

    rows, columns = surface.shape[:2]
    cv2.rectangle(surface, (0, rows - paint.px(0.09)), (columns, rows), paint.color(0.2, 0.7), cv2.FILLED)
    for _ in range(round(30 * run)):
        w, h = paint.rng.uniform(0.28, 0.85, 2)
        left, bottom = paint.rng.uniform((0.05, 0.5), (max(0.06, run - w - 0.05), max(0.51, height - h - 0.06)))
        spot = (left, bottom, left + w, bottom + h)
        if bottom + h < height and all(_has_gap(spot, other, 0.06) for other in taken):
            taken.append(spot)
            painting = poster(paint, w, h, deck.posters)
            deck.posters += 1
            _hang(surface, painting, paint.px(left), rows - paint.px(bottom + h))
    return [quad((0, 0, height), (run, 0, 0), (0, 0, -height), surface), *quads]


def _has_gap(a: tuple[float, ...], b: tuple[float, ...], gap: float) -> bool:
    return a[2] + gap < b[0] or b[2] + gap < a[0] or a[3] + gap < b[1] or b[3] + gap < a[1]


def _hang(surface: Image, painting: Image, x: int, y: int) -> None:
    """Put an image on a wall, over a soft shadow of itself."""
    height, width = painting.shape[:2]
    edge = max(2, width // 24)
    below = surface[y : y + height + edge, x : x + width + edge]
    below[:] = (below * 0.6).astype(np.uint8)
    target = surface[y : y + height, x : x + width]
    target[:] = painting[: target.shape[0], : target.shape[1]]


def _ceiling(paint: Paint, length: float, width: float, height: float) -> list[Quad]:
    """A stained ceiling and the lamps under it."""
    image = plaster(paint, length, width, paint.color(0.12, 0.85))
    grid = tiles(paint, length, width, 0.62, [(238, 236, 228), (226, 226, 220), (214, 216, 216)])
    image = mixed(image, grid, np.full(image.shape[:2], 0.55, dtype=np.float32))
    quads = [quad((-length / 2, -width / 2, height), (length, 0, 0), (0, width, 0), image)]
    count = max(2, round(length / 2.4))
    for k in range(count):
        x, y = (k + 0.5) / count * length - length / 2, paint.rng.uniform(-0.2, 0.2) * width
        w, d = paint.rng.uniform((0.5, 0.25), (1.0, 0.5))
        lower, upper = (x - w / 2, y - d / 2, height - 0.09), (x + w / 2, y + d / 2, height)
        quads += box(lower, upper, partial(plain, paint, color=(120, 120, 126)), omit=("bottom", "top"))
        quads.append(quad(lower, (w, 0, 0), (0, d, 0), plain(paint, w, d, (255, 244, 222), 0.02), glows=True))
    return quads


def _floor(paint: Paint, length: float, width: float) -> Quad:
    """Planks under rugs of different patterns."""
    image = wood(paint, length, width, paint.color(0.5, 0.6, hue=paint.rng.uniform(0.06, 0.09)))
    for k in range(3):
        w, d = paint.rng.uniform((1.0, 0.7), (1.9, 1.2))
        x, y = np.array([0.5 + 0.3 * (k - 1), 0.5]) + paint.rng.uniform(-1, 1, 2) * (0.06, 0.2)
        center_px = np.array([x * length, y * width]) * paint.px_per_m
        _lay(image, _rug(paint, w, d), center_px, paint.rng.uniform(0, 180))
    return quad((-length / 2, width / 2, 0), (length, 0, 0), (0, -width, 0), image)


def _rug(paint: Paint, width: float, depth: float) -> Image:
    rug = tiles(paint, width, depth, paint.rng.uniform(0.06, 0.16), [paint.color(0.6, 0.55) for _ in range(4)])
    rows, columns = rug.shape[:2]
    for k, edge in enumerate((0.0, 0.06, 0.12)):
        corner = paint.px(edge)
        color = paint.color(0.6, 0.3 + 0.25 * k)
        cv2.rectangle(rug, (corner, corner), (columns - 1 - corner, rows - 1 - corner), color, paint.px(0.04))
    return rug


def _lay(floor: Image, rug: Image, center_px: Vectors, turn_deg: float) -> None:
    """Paint a rug onto the floor, turned about its middle."""
    rows, columns = rug.shape[:2]
    move = cv2.getRotationMatrix2D((columns / 2, rows / 2), turn_deg, 1.0)
    move[:, 2] += center_px - (columns / 2, rows / 2)
    size = floor.shape[1::-1]
    cover = cv2.warpAffine(np.full((rows, columns), 255, dtype=np.uint8), move, size)
    cv2.copyTo(cv2.warpAffine(rug, move, size), (cover > 127).astype(np.uint8), floor)


def _upright(up: Vectors) -> Vectors:
    """The rotation (3, 3) that takes ``z`` to the world axis nearest to ``up``."""
    axis = int(np.argmax(np.abs(up)))
    z = np.sign(up[axis]) * np.eye(3)[axis]
    x = np.eye(3)[(axis + 1) % 3]
    return np.stack([x, np.cross(z, x), z], axis=1)


def _without_outliers(positions: Vectors) -> Vectors:
    low, high = np.percentile(positions, [2, 98], axis=0)
    reach = 3 * (high - low) + 1
    return positions[((positions > low - reach) & (positions < high + reach)).all(axis=1)]
