"""Light that stays: lamps, windows and the shadows of the furniture, baked once into a room's textures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.rendering.quads import Image, Quad, Vectors

_CELL_M = 0.16  # one light probe per so many metres of surface
_MAX_CELLS = 48
_LIFT_M = 0.006  # probes stand off their surface, or it would shade itself


def lit(quads: Sequence[Quad], ambient: float = 0.55, gain: float = 5.5) -> list[Quad]:
    """The same quads with their textures shaded by those that glow, every quad throwing its shadow.

    Args:
        quads: the whole room.
        ambient: the light that reaches every surface.
        gain: the brightness of what glows, for each square metre of it.
    """
    probes = [_probes(q) for q in quads]
    points = np.concatenate([points for points, _, _ in probes])
    normals = np.concatenate([normals for _, normals, _ in probes])
    # More on level surfaces than on upright ones, as floor and ceiling throw light at each other.
    light = np.repeat(ambient * (1 + 0.25 * np.abs(normals[:, 2:])), 3, axis=1)
    light += _direct_light(quads, points, normals, gain)
    ends = np.cumsum([len(points) for points, _, _ in probes])[:-1]
    fields = (part.reshape(*shape, 3) for part, (_, _, shape) in zip(np.split(light, ends), probes, strict=True))
    return [q if q.glows else replace(q, texture=_shaded(q, field)) for q, field in zip(quads, fields, strict=True)]


def _probes(quad: Quad) -> tuple[Vectors, Vectors, tuple[int, int]]:
    """Points (P, 3) on a grid over the quad, just in front of it, their normals (P, 3), and the grid's shape."""
    sizes_m = np.linalg.norm(quad.u_m), np.linalg.norm(quad.v_m)
    columns, rows = (int(np.clip(np.ceil(size / _CELL_M), 2, _MAX_CELLS)) for size in sizes_m)
    s, t = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    normal = np.cross(quad.v_m, quad.u_m)
    normal = normal / np.linalg.norm(normal)
    points = quad.corner_m + s.reshape(-1, 1) * quad.u_m + t.reshape(-1, 1) * quad.v_m + _LIFT_M * normal
    return points, np.broadcast_to(normal, points.shape), (rows, columns)


def _direct_light(quads: Sequence[Quad], points: Vectors, normals: Vectors, gain: float) -> Vectors:
    """What arrives at probes (P, 3) straight from four spots on each glowing quad, RGB (P, 3)."""
    spots, facings, powers = [], [], []
    for q in quads:
        if q.glows:
            normal = np.cross(q.v_m, q.u_m)
            area_m2 = np.linalg.norm(normal)
            for s, t in ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)):
                spots.append(q.corner_m + s * q.u_m + t * q.v_m + 0.03 * normal / area_m2)
                facings.append(normal / area_m2)
                powers.append(gain * area_m2 * q.texture.mean(axis=(0, 1)) / 255 / 4)
    if not spots:
        return np.zeros_like(points)
    towards = np.stack(spots)[:, None] - points  # (S, P, 3)
    arriving = np.einsum("spk,pk->sp", towards, normals)
    leaving = -np.einsum("spk,sk->sp", towards, np.stack(facings))
    distance2 = np.einsum("spk,spk->sp", towards, towards)
    reached = (arriving > 0) & (leaving > 0)
    _cast_shadows(reached, quads, points, np.stack(spots))
    falls = np.where(reached, arriving * leaving / (distance2 * (distance2 + 0.3)), 0)
    return falls.T @ np.stack(powers)


def _cast_shadows(reached: NDArray[np.bool_], quads: Sequence[Quad], points: Vectors, spots: Vectors) -> None:
    """Clear ``reached`` (S, P) where a quad cuts the straight line between a spot (S, 3) and a probe (P, 3)."""
    for q in quads:
        if q.glows or np.linalg.norm(np.cross(q.u_m, q.v_m)) < _CELL_M**2:  # too small for the probes to resolve
            continue
        # In the quad's own coordinates (s, t, height) it is the unit square at height 0.
        own = np.linalg.inv(np.stack([q.u_m, q.v_m, np.cross(q.u_m, q.v_m)], axis=1))
        probe, spot = (points - q.corner_m) @ own.T, (spots - q.corner_m) @ own.T
        behind, above = probe[:, 2] < 0, spot[:, 2] > 0
        i, j = np.nonzero((behind[None] == above[:, None]) & reached)
        share = probe[j, 2] / (probe[j, 2] - spot[i, 2])
        hit = probe[j, :2] + share[:, None] * (spot[i, :2] - probe[j, :2])
        blocked = ((hit > 0) & (hit < 1)).all(axis=1)
        reached[i[blocked], j[blocked]] = False


def _shaded(quad: Quad, light: Vectors) -> Image:
    height, width = quad.texture.shape[:2]
    smooth = cv2.resize(light.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    # A soft shoulder instead of a hard clip: bright walls keep their pattern.
    exposed = quad.texture / np.float32(255) * smooth
    return (255 * exposed / np.power(1 + exposed**4, np.float32(0.25))).astype(np.uint8)
