"""Textured parallelograms: the one primitive of which every rendered scene is made."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Image = NDArray[Any]  # uint8; OpenCV's stubs promise no more than numbers
Vectors = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Quad:
    """A textured parallelogram, seen from its front only.

    ``corner_m`` is where the texture's top-left corner goes, ``u_m`` its top edge and ``v_m`` its left edge,
    as seen from the front; the front normal is therefore ``v × u``. A quad that ``glows`` is not shaded.

    Shape:
        ``corner_m``, ``u_m`` and ``v_m`` (3,) in metres, ``texture`` (H, W, 3) RGB ``uint8``.
    """

    corner_m: Vectors
    u_m: Vectors
    v_m: Vectors
    texture: Image
    glows: bool = False

    @cached_property
    def pyramid(self) -> tuple[Image, ...]:
        """The texture and its halvings down to a few texels, finest first."""
        # Area averaging keeps the texture's outline; pyrDown would shift each level by half a texel.
        levels = [self.texture]
        while min(levels[-1].shape[:2]) >= 8:
            height, width = levels[-1].shape[:2]
            levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
        return tuple(levels)

    def moved(self, linear: ArrayLike, offset_m: ArrayLike) -> Quad:
        """The same quad with every point ``p`` taken to ``linear @ p + offset_m``."""
        a, b = np.asarray(linear, dtype=float), np.asarray(offset_m, dtype=float)
        return replace(self, corner_m=a @ self.corner_m + b, u_m=a @ self.u_m, v_m=a @ self.v_m)


@dataclass(frozen=True, eq=False)
class Room:
    """Everything there is to see: quads in the world frame, and the box in which a camera is free to move.

    Shape:
        ``inside_m`` (2, 3): the lower and the upper corner of the free box, metres.
    """

    quads: tuple[Quad, ...]
    inside_m: Vectors

    @cached_property
    def frames_m(self) -> Vectors:
        """(Q, 3, 3): the columns ``u``, ``v`` and ``corner`` of every quad."""
        return np.stack([np.stack([q.u_m, q.v_m, q.corner_m], axis=1) for q in self.quads])

    @cached_property
    def texture_sizes_px(self) -> Vectors:
        """(Q, 2): every texture's width and height."""
        return np.array([q.texture.shape[1::-1] for q in self.quads], dtype=float)

    def moved(self, linear: ArrayLike, offset_m: ArrayLike) -> Room:
        """The same room with every point ``p`` taken to ``linear @ p + offset_m``."""
        corners_m = self.inside_m @ np.asarray(linear, dtype=float).T + offset_m
        inside_m = np.stack([corners_m.min(axis=0), corners_m.max(axis=0)])
        return Room(tuple(q.moved(linear, offset_m) for q in self.quads), inside_m)


def quad(corner_m: ArrayLike, u_m: ArrayLike, v_m: ArrayLike, texture: Image, glows: bool = False) -> Quad:
    """A :class:`Quad` from any three vectors (3,), metres."""
    corner, u, v = (np.asarray(a, dtype=float) for a in (corner_m, u_m, v_m))
    return Quad(corner, u, v, texture, glows)


def box(
    lower_m: Sequence[float],
    upper_m: Sequence[float],
    paint_face: Callable[[float, float], Image],
    omit: Iterable[str] = ("bottom", "back"),
    **painted: Image,
) -> list[Quad]:
    """The faces of an upright box, its front towards ``-y``.

    ``paint_face(width_m, height_m)`` paints the faces that ``painted`` does not name
    (``front back left right top bottom``), and those in ``omit`` are left out.
    """
    (x0, y0, z0), (x1, y1, z1) = lower_m, upper_m
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    faces = {
        "front": ((x0, y0, z1), (dx, 0, 0), (0, 0, -dz)),
        "back": ((x1, y1, z1), (-dx, 0, 0), (0, 0, -dz)),
        "left": ((x0, y1, z1), (0, -dy, 0), (0, 0, -dz)),
        "right": ((x1, y0, z1), (0, dy, 0), (0, 0, -dz)),
        "top": ((x0, y1, z1), (dx, 0, 0), (0, -dy, 0)),
        "bottom": ((x0, y0, z0), (dx, 0, 0), (0, dy, 0)),
    }
    quads = []
    for name, (corner, u, v) in faces.items():
        if name not in omit:
            texture = painted.get(name)
            quads.append(quad(corner, u, v, paint_face(_length(u), _length(v)) if texture is None else texture))
    return quads


def placed(quads: Iterable[Quad], offset_m: ArrayLike, yaw_rad: float = 0.0) -> list[Quad]:
    """The quads turned about ``z`` by ``yaw_rad`` and then shifted."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return [q.moved(turn, offset_m) for q in quads]


def _length(vector: Sequence[float]) -> float:
    return float(np.linalg.norm(vector))
