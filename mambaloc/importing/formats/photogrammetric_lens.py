"""Brown's lens model as photogrammetric programs write it: Agisoft Metashape, RealityScan and RealityCapture.

With ``r² = x² + y²``, where x and y are a ray's, or those of an equidistant fisheye::

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + (p1 (r² + 2x²) + 2 p2 xy) (1 + p3 r² + p4 r⁴)
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + (p2 (r² + 2y²) + 2 p1 xy) (1 + p3 r² + p4 r⁴)
    u = cx + x' f + x' b1 + y' b2,    v = cy + y' f

So p1 is what OpenCV calls p2, and the other way. Source: "Camera models" in the appendices of Metashape's manual; the
OpenCV export format that RealityScan ships (``calibration.xml``) writes its t2 where OpenCV has p1, and t1 as p2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from mambaloc.runtime.camera_models import OpenCVModel

Pixels = NDArray[np.float64]


def photogrammetric_lens(
    focal_px: float,
    center_px: tuple[float, float],
    radial: Sequence[float],
    tangential: Sequence[float],
    affinity_px: tuple[float, float] = (0.0, 0.0),
    is_fisheye: bool = False,
) -> Callable[[Pixels], Pixels]:
    """Pixels (N, 2) of rays (N, 2), which are ``x / z`` and ``y / z``.

    Args:
        focal_px: f.
        centre_px: principal point.
        radial: k1 to k4.
        tangential: p1 to p4.
        affinity_px: b1 and b2.
        is_fisheye: whether the lens is equidistant before it is distorted.
    """
    k1, k2, k3, k4 = radial
    p1, p2, p3, p4 = tangential
    if not is_fisheye and not any((k4, p3, p4, *affinity_px)):
        return OpenCVModel((focal_px, focal_px), center_px, (k1, k2, p2, p1, k3))  # which can be kept for queries

    def distorted(rays: Pixels) -> Pixels:
        if is_fisheye:
            length = np.linalg.norm(rays, axis=1, keepdims=True)
            rays = rays * np.where(length > 0, np.arctan(length) / np.where(length > 0, length, 1.0), 1.0)
        x, y = rays.T
        with np.errstate(over="ignore", invalid="ignore"):  # far outside of the image
            r2 = x**2 + y**2
            scale = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
            more = 1 + r2 * (p3 + r2 * p4)
            bent_x = x * scale + (p1 * (r2 + 2 * x**2) + 2 * p2 * x * y) * more
            bent_y = y * scale + (p2 * (r2 + 2 * y**2) + 2 * p1 * x * y) * more
            u = center_px[0] + bent_x * (focal_px + affinity_px[0]) + bent_y * affinity_px[1]
            return np.stack((u, center_px[1] + bent_y * focal_px), axis=1)

    return distorted
