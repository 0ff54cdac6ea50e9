"""A perspective camera for rooms made of quads: deferred, anti-aliased, exact on every plane.

With ``M = K @ [u v corner]`` (all in camera axes) a quad's texture coordinates ``(s, t)`` in 0..1 and a pixel
``(x, y)`` at depth ``z`` meet in ``M @ (s, t, 1) = z * (x, y, 1)``. So ``inv(M) @ (x, y, 1) = (s, t, 1) / z``:
one inverse per quad gives the texture lookup (its homography) and the inverse depth (its last row, an affine
function of the pixel), and ``det(M) > 0`` says that the quad's front faces the camera.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mambaloc.rendering.quads import Image, Room, Vectors

NEAR_M = 0.02
_TOUCH_PX = 1e-4  # quads cover what they touch, so that no crack opens where two of them meet
_BORDER_PX = 4.0  # polygons are cut this far outside of the image


def default_intrinsics(size: tuple[int, int]) -> Vectors:
    """The (3, 3) pinhole matrix of a phone-like lens, 58 degrees wide, for ``size = (width, height)``."""
    width, height = size
    focal_px = 0.9 * width
    return np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])


def render(
    room: Room, intrinsics: ArrayLike, world_from_cam: ArrayLike, size: tuple[int, int], samples: int = 2
) -> tuple[Image, NDArray[np.float32]]:
    """Image and depth of a room as a pinhole camera sees them.

    Args:
        room: what there is to see.
        intrinsics: (3, 3) pinhole matrix, pixels; the centre of the top-left pixel is ``(0, 0)``.
        world_from_cam: (4, 4) camera pose, metres, OpenCV camera axes.
        size: ``(width, height)`` in pixels.
        samples: each pixel averages ``samples × samples`` rays.

    Returns:
        RGB ``uint8`` (H, W, 3), black where there is nothing, and depth along the optical axis in metres
        ``float32`` (H, W) at the pixel centres, 0 where there is nothing.
    """
    shift = (samples - 1) / 2
    sample_from_pixel = np.array([[samples, 0, shift], [0, samples, shift], [0, 0, 1]])
    cam_from_world = np.linalg.inv(np.asarray(world_from_cam, dtype=float))
    frames = cam_from_world[:3, :3] @ room.frames_m
    frames[:, :, 2] += cam_from_world[:3, 3]
    pixel_from_quad = sample_from_pixel @ np.asarray(intrinsics, dtype=float) @ frames

    fine = (size[0] * samples, size[1] * samples)
    polygons = _visible_polygons(pixel_from_quad, fine)
    quad_from_pixel = np.zeros_like(pixel_from_quad)
    seen = list(polygons)
    quad_from_pixel[seen] = np.linalg.inv(pixel_from_quad[seen])

    index, inverse_depth, windows = _nearest_quads(polygons, quad_from_pixel[:, 2], fine)
    rgb = _paint(room, index, inverse_depth, windows, quad_from_pixel)
    if samples > 1:
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return rgb, _depth_at_centers(index, quad_from_pixel[:, 2], samples)


def sensor(rgb: Image, rng: np.random.Generator) -> Image:
    """The image as a small camera would record it: a little exposure wander and noise in each pixel."""
    gain = np.float32(rng.uniform(0.94, 1.06))
    noise = rng.standard_normal(rgb.shape, dtype=np.float32)
    return np.clip(rgb * gain + noise * np.float32(2.0), 0, 255).astype(np.uint8)


def _visible_polygons(pixel_from_quad: Vectors, size: tuple[int, int]) -> dict[int, Vectors]:
    """The part of each front-facing quad that is in view, as pixels (N, 2), by quad number."""
    width, height = size
    low, right, bottom = -_BORDER_PX, width - 1 + _BORDER_PX, height - 1 + _BORDER_PX
    # Half-spaces of homogeneous pixels (x*z, y*z, z): a point is in view where all five are positive.
    planes = np.array([[1, 0, -low], [0, 1, -low], [-1, 0, right], [0, -1, bottom], [0, 0, 1]])
    offsets = np.array([0, 0, 0, 0, -NEAR_M])
    unit_square = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])

    corners = unit_square @ pixel_from_quad.transpose(0, 2, 1)
    inside = corners @ planes.T + offsets
    candidate = (inside > 0).any(axis=1).all(axis=1) & (np.linalg.det(pixel_from_quad) > 1e-9)
    polygons = {}
    for number in np.flatnonzero(candidate):
        polygon = list(corners[number])
        for plane in np.flatnonzero((inside[number] <= 0).any(axis=0)):
            polygon = _clip(polygon, planes[plane], offsets[plane])
        if len(polygon) >= 3:
            points = np.array(polygon)
            polygons[int(number)] = points[:, :2] / points[:, 2:]
    return polygons


def _clip(polygon: list[Vectors], plane: Vectors, offset: float) -> list[Vectors]:
    """Sutherland-Hodgman: the part of a convex polygon on the positive side of a plane."""
    sides = [float(point @ plane + offset) for point in polygon]
    kept: list[Vectors] = []
    for i, (point, side) in enumerate(zip(polygon, sides, strict=True)):
        last_point, last_side = polygon[i - 1], sides[i - 1]
        if (side > 0) != (last_side > 0):
            kept.append(last_point + (point - last_point) * (last_side / (last_side - side)))
        if side > 0:
            kept.append(point)
    return kept


Window = tuple[slice, slice]


def _nearest_quads(
    polygons: dict[int, Vectors], depth_planes: Vectors, size: tuple[int, int]
) -> tuple[NDArray[np.int16], NDArray[np.float32], dict[int, Window]]:
    """The z-buffer: the nearest quad's number at every pixel (-1 for none), its inverse depth, and quads' windows."""
    index = np.full(size[::-1], -1, dtype=np.int16)
    inverse_depth = np.zeros(size[::-1], dtype=np.float32)
    windows = {}
    for number, polygon in polygons.items():
        x0, y0 = np.clip(np.ceil(polygon.min(axis=0) - _TOUCH_PX).astype(int), 0, size)
        x1, y1 = np.clip(np.floor(polygon.max(axis=0) + _TOUCH_PX).astype(int) + 1, 0, size)
        if x0 >= x1 or y0 >= y1:
            continue
        window = (slice(y0, y1), slice(x0, x1))
        a, b, c = depth_planes[number]
        x, y = np.arange(x0, x1), np.arange(y0, y1)
        plane = (b * y + c).astype(np.float32)[:, None] + (a * x).astype(np.float32)
        left, right = _row_ends(polygon, y)
        nearer = plane > inverse_depth[window]
        nearer &= x.astype(np.float32) >= left[:, None]
        nearer &= x.astype(np.float32) <= right[:, None]
        np.copyto(inverse_depth[window], plane, where=nearer)
        np.copyto(index[window], np.int16(number), where=nearer)
        windows[number] = window
    return index, inverse_depth, windows


def _row_ends(polygon: Vectors, y: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where a convex polygon (N, 2), clockwise on the screen, begins and ends in each of its rows ``y``."""
    left, right = np.full(len(y), -np.inf), np.full(len(y), np.inf)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 != y1:
            edge = x0 + (y - y0) * ((x1 - x0) / (y1 - y0))
            if y1 < y0:
                np.maximum(left, edge, out=left)
            else:
                np.minimum(right, edge, out=right)
    return (left - _TOUCH_PX).astype(np.float32), (right + _TOUCH_PX).astype(np.float32)


def _paint(
    room: Room,
    index: NDArray[np.int16],
    inverse_depth: NDArray[np.float32],
    windows: dict[int, Window],
    quad_from_pixel: Vectors,
) -> Image:
    """Look up every pixel's texture, each in the pyramid level whose texels are about as large as the pixel."""
    rgb = np.zeros((*index.shape, 3), dtype=np.uint8)
    for number, window in windows.items():
        mine = index[window] == number
        if not mine.any():
            continue
        nearness = inverse_depth[window]
        pyramid = room.quads[number].pyramid
        # A homography H scales areas by det(H) / w^3, and w is the inverse depth: texels per pixel, exactly.
        texels_at_1m = float(room.texture_sizes_px[number].prod() * np.linalg.det(quad_from_pixel[number]))
        for level, texture in enumerate(pyramid):
            nearest = np.inf if level == 0 else _inverse_depth_where(texels_at_1m, level)
            farthest = 0.0 if level == len(pyramid) - 1 else _inverse_depth_where(texels_at_1m, level + 1)
            here = mine & (nearness > farthest) & (nearness <= nearest)
            if here.any():
                _lookup(rgb[window], here, texture, quad_from_pixel[number], window)
    return rgb


def _inverse_depth_where(texels_at_1m: float, level: int) -> float:
    """The inverse depth beyond which ``level`` is fine enough: ``4**(level - 1/2)`` texels to the pixel."""
    return float(np.cbrt(texels_at_1m / 4 ** (level - 0.5)))


def _lookup(target: Image, where: NDArray[np.bool_], texture: Image, quad_from_pixel: Vectors, window: Window) -> None:
    """Copy a texture, seen through its homography, into the masked part of a window of the image."""
    columns, rows = np.flatnonzero(where.any(axis=0)), np.flatnonzero(where.any(axis=1))
    x0, x1, y0, y1 = columns[0], columns[-1] + 1, rows[0], rows[-1] + 1
    height, width = texture.shape[:2]
    texel_from_quad = np.array([[width, 0, -0.5], [0, height, -0.5], [0, 0, 1]])
    shift = np.array([[1, 0, window[1].start + x0], [0, 1, window[0].start + y0], [0, 0, 1]])
    seen = cv2.warpPerspective(
        texture,
        texel_from_quad @ quad_from_pixel @ shift,
        (int(x1 - x0), int(y1 - y0)),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    cv2.copyTo(seen, where[y0:y1, x0:x1].view(np.uint8), target[y0:y1, x0:x1])


def _depth_at_centers(index: NDArray[np.int16], depth_planes: Vectors, samples: int) -> NDArray[np.float32]:
    middle = index[samples // 2 :: samples, samples // 2 :: samples]
    planes = np.vstack([depth_planes, np.zeros(3)]).astype(np.float32)[middle]  # -1 finds the zeros at the end
    offset = np.float32((samples - 1) / 2)
    x = np.arange(middle.shape[1], dtype=np.float32) * samples + offset
    y = np.arange(middle.shape[0], dtype=np.float32)[:, None] * samples + offset
    inverse = planes[..., 0] * x + planes[..., 1] * y + planes[..., 2]
    return np.divide(1, inverse, out=np.zeros_like(inverse), where=middle >= 0)
