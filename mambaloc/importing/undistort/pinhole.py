"""The pinhole whose image a distorted one can fill, without black borders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.importing.capture import Camera

_NARROWEST = 8.0  # as a factor of the focal length, at which any lens that is one fills the image
_WIDEST = 0.05
_SEARCH = 0.98
_BORDER_POINTS = 200  # a side


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


def _reach(camera: Camera, zoom: float) -> NDArray[np.float64] | None:
    """How far from the centre a pinhole's border is seen, in pixels; None where a part of it is outside the image."""
    last = np.array((camera.width - 1, camera.height - 1), dtype=np.float64)
    along = np.linspace(0, 1, _BORDER_POINTS)
    sides = [np.stack((along, np.full_like(along, end)), axis=-1) for end in (0, 1)]
    border = np.concatenate([*sides, *(side[:, ::-1] for side in sides)]) * last
    rays = (border - camera.center_px) / (np.array(camera.focal_px) * zoom)
    assert camera.distorted is not None
    seen = camera.distorted(rays)
    if not np.isfinite(seen).all() or (seen < 0).any() or (seen > last).any():
        return None
    return np.linalg.norm(seen - camera.center_px, axis=-1)
