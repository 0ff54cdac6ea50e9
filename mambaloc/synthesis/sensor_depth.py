"""Depth that a sensor measured, carried into the colour camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.synthesis.posed_depth import Floats


def carried_depth(
    depth_m: Floats, depth_intrinsics: Floats, intrinsics: Floats, size: tuple[int, int]
) -> NDArray[np.float32]:
    """Depth of each pixel of an image, from a depth camera that sits where the colour camera sits.

    Args:
        depth_m: (H, W), NaN where nothing was measured.
        depth_intrinsics: (3, 3) in pixels of ``depth_m``.
        intrinsics: (3, 3) in pixels of the image.
        size: (height, width) of the image.

    Returns:
        (height, width), NaN where nothing was measured or the depth camera does not look.
    """
    homography = depth_intrinsics @ np.linalg.inv(intrinsics)
    return cv2.warpPerspective(  # type: ignore[return-value]
        depth_m.astype(np.float32),
        homography,
        size[::-1],
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )
