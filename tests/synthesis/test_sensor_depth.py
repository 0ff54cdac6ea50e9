"""Sensor depth in the colour camera, on a slanted wall whose depth is known along every ray."""

import numpy as np

from mambaloc.synthesis import carried_depth

DEPTH_CAMERA = np.array([[58.5, 0, 32.0], [0, 58.5, 24.0], [0, 0, 1]])
COLOR_CAMERA = np.array([[21.0, 0, 12.5], [0, 21.0, 9.5], [0, 0, 1]])


def wall(intrinsics, size):
    """Depth of the wall ``0.2 x + 0.1 y + z = 2`` in each pixel."""
    y, x = np.mgrid[: size[0], : size[1]]
    rays = np.stack((x, y, np.ones_like(x)), axis=-1) @ np.linalg.inv(intrinsics).T
    return 2 / (rays @ (0.2, 0.1, 1))


def test_depth_is_that_of_each_pixels_ray_where_the_sensor_looks():
    carried = carried_depth(wall(DEPTH_CAMERA, (48, 64)), DEPTH_CAMERA, COLOR_CAMERA, (20, 26))
    rays_x, rays_y = (np.arange(26) - 12.5) / 21, (np.arange(20) - 9.5) / 21
    sees_x = (rays_x * 58.5 + 32 > -0.5) & (rays_x * 58.5 + 32 < 63.5)
    sees_y = (rays_y * 58.5 + 24 > -0.5) & (rays_y * 58.5 + 24 < 47.5)
    np.testing.assert_array_equal(np.isfinite(carried), sees_y[:, None] & sees_x)
    assert 0 < sees_x.sum() < 26  # the colour camera sees more
    off = carried / wall(COLOR_CAMERA, (20, 26)) - 1
    assert np.nanmax(np.abs(off)) < 0.003  # half a pixel of the sensor, along the wall's slant


def test_pixel_without_depth_stays_without():
    depth_m = wall(DEPTH_CAMERA, (48, 64))
    depth_m[20:28, 28:36] = np.nan
    carried = carried_depth(depth_m, DEPTH_CAMERA, COLOR_CAMERA, (20, 26))
    assert np.isnan(carried[9:11, 12:14]).all()
    assert np.isfinite(carried[4, 4])
    assert carried.dtype == np.float32
