"""Images are sampled where the lens says, to far below OpenCV 4's thirty-second of a pixel."""

from __future__ import annotations

import numpy as np

from mambaloc.runtime.camera_models import Pinhole
from mambaloc.runtime.undistortion import sampled_at, undistorted


def test_samples_are_not_rounded_to_a_thirty_second_of_a_pixel():
    """Guess: ``cv2.remap`` is exact. 4.12 rounds places to 1/32 pixel, up to 4 of 255 levels here; 5.0 does not.

    ``cv2.undistort`` still does in 5.0, so images go through maps of our own.
    """
    stripes = np.tile(np.array([0, 255], np.uint8), (40, 64))
    shifts_px = np.linspace(0, 1, 101)[:-1]

    def sample(shift_px: float) -> float:
        maps = sampled_at(
            lambda rays: 100.0 * rays + (63.5 + shift_px, 19.5), Pinhole(128, 40, (100.0, 100.0), (63.5, 19.5))
        )
        seen = undistorted(stripes, maps)
        return float(seen[20, 64])  # a column of 0, beside one of 255

    np.testing.assert_allclose([sample(shift) for shift in shifts_px], 255 * shifts_px, atol=0.6)
