"""Lens distortion: OpenCV's models, and how an image is made that of a pinhole, without black borders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.importing.capture import Camera

Pixels = NDArray[np.float64]

_NARROWEST = 8.0  # as a factor of the focal length, at which any lens that is one fills the image
_WIDEST = 0.05
_SEARCH = 0.98
_BORDER_POINTS = 200  # a side


def opencv_lens(
    focal_px: tuple[float, float], centre_px: tuple[float, float], coefficients: Sequence[float]
) -> Callable[[Pixels], Pixels]:
    """Brown's model as OpenCV has it: pixels (N, 2) of rays (N, 2).

    Args:
        focal_px: along x and y.
        centre_px: principal point.
        coefficients: k1, k2, p1, p2, and k3 if there is one.
    """
    matrix, told = _matrix(focal_px, centre_px), np.array(coefficients, dtype=np.float64)

    def distorted(rays: Pixels) -> Pixels:
        points = np.concatenate((rays, np.ones((len(rays), 1))), axis=1)[:, None]
        return cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, told)[0][:, 0].astype(np.float64)

    return distorted


def opencv_fisheye(
    focal_px: tuple[float, float], centre_px: tuple[float, float], coefficients: Sequence[float]
) -> Callable[[Pixels], Pixels]:
    """OpenCV's fisheye, an equidistant lens; the arguments of :func:`opencv_lens`, with k1 to k4."""
    matrix, told = _matrix(focal_px, centre_px), np.array(coefficients, dtype=np.float64)

    def distorted(rays: Pixels) -> Pixels:
        return cv2.fisheye.distortPoints(np.ascontiguousarray(rays)[:, None], matrix, told)[:, 0].astype(np.float64)

    return distorted


def pinhole_of(name: str, camera: Camera) -> Camera:
    """The pinhole of the same size, centre and shape of pixels that sees as much as it can, and all in the image.

    Args:
        name: of the camera, for messages.
        camera: with or without distortion.

    Raises:
        InputError: where the distortion is that of no lens.
    """
    if camera.distorted is None:
        return camera
    zoom = _NARROWEST
    reach = _reach(camera, zoom)
    if reach is None:
        raise InputError(f"camera {name}: its distortion maps nothing into the image; calibrate it again")
    while zoom > _WIDEST:
        wider = _reach(camera, zoom * _SEARCH)
        # A polynomial may fold back beyond the image's border: what lies farther out must be seen farther out.
        if wider is None or (wider <= reach).any():
            break
        zoom, reach = zoom * _SEARCH, wider
    low, high = zoom * _SEARCH, zoom
    for _ in range(20):
        middle = (low + high) / 2
        found = _reach(camera, middle)
        low, high = (low, middle) if found is not None and (found > reach).all() else (middle, high)
    focal_px = (camera.focal_px[0] * high, camera.focal_px[1] * high)
    return replace(camera, focal_px=focal_px, distorted=None, model="pinhole")


def sampled_at(camera: Camera, pinhole: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where each pixel of the pinhole's image lies in the camera's: columns and rows (H, W), for ``cv2.remap``."""
    columns, rows = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    pixels = np.stack((columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    rays = (pixels - pinhole.centre_px) / pinhole.focal_px
    assert camera.distorted is not None
    seen = camera.distorted(rays).astype(np.float32).reshape(pinhole.height, pinhole.width, 2)
    return np.ascontiguousarray(seen[..., 0]), np.ascontiguousarray(seen[..., 1])


def _reach(camera: Camera, zoom: float) -> NDArray[np.float64] | None:
    """How far from the centre a pinhole's border is seen, in pixels; None where a part of it is outside the image."""
    last = np.array((camera.width - 1, camera.height - 1), dtype=np.float64)
    along = np.linspace(0, 1, _BORDER_POINTS)
    sides = [np.stack((along, np.full_like(along, end)), axis=-1) for end in (0, 1)]
    border = np.concatenate([*sides, *(side[:, ::-1] for side in sides)]) * last
    rays = (border - camera.centre_px) / (np.array(camera.focal_px) * zoom)
    assert camera.distorted is not None
    seen = camera.distorted(rays)
    if not np.isfinite(seen).all() or (seen < 0).any() or (seen > last).any():
        return None
    return np.linalg.norm(seen - camera.centre_px, axis=-1)


def _matrix(focal_px: tuple[float, float], centre_px: tuple[float, float]) -> NDArray[np.float64]:
    return np.array([[focal_px[0], 0, centre_px[0]], [0, focal_px[1], centre_px[1]], [0, 0, 1]])
