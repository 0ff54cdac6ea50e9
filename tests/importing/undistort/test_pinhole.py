"""Lenses against OpenCV and by hand, and pinholes without black borders."""

import cv2
import numpy as np
import pytest

from mambaloc.errors import InputError
from mambaloc.images import LARGEST_SIDE_PX
from mambaloc.importing.capture import Camera
from mambaloc.importing.undistort.pinhole import pinhole_of
from mambaloc.runtime.camera_models import FisheyeModel, OpenCVModel
from mambaloc.runtime.undistortion import sampled_at

WIDTH, HEIGHT = 320, 240
LENSES = {
    "barrel": (-0.25, 0.06, 0.0, 0.0, 0.0),
    "pincushion": (0.2, 0.05, 0.0, 0.0, 0.0),
    "tangential": (-0.05, 0.01, 0.01, -0.008, 0.0),
    "sixth power": (0.1, -0.2, 0.001, 0.0, 0.1),
    "folds back": (-0.9, 0.1, 0.0, 0.0, 0.0),
}


def camera(coefficients, focal_px=(250.0, 240.0), center_px=(150.0, 125.0), lens=OpenCVModel):
    return Camera(WIDTH, HEIGHT, focal_px, center_px, lens(focal_px, center_px, coefficients))


def matrix_of(camera):
    return np.array(
        [[camera.focal_px[0], 0, camera.center_px[0]], [0, camera.focal_px[1], camera.center_px[1]], [0, 0, 1]]
    )


def test_a_lens_by_hand():
    k1, k2, p1, p2, k3 = told = (0.1, -0.05, 0.01, -0.02, 0.03)
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    seen_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    seen_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    (found,) = camera(told).distorted(np.array([[x, y]]))
    np.testing.assert_allclose(found, (250 * seen_x + 150, 240 * seen_y + 125), atol=1e-9)


def test_a_fisheye_by_hand():
    told = k1, k2, k3, k4 = (0.05, -0.02, 0.01, -0.005)
    x, y = 0.8, 0.6
    theta = np.arctan(np.hypot(x, y))
    reach = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) / np.hypot(x, y)
    (found,) = camera(told, lens=FisheyeModel).distorted(np.array([[x, y]]))
    np.testing.assert_allclose(found, (250 * reach * x + 150, 240 * reach * y + 125), atol=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_a_pinhole_shows_all_it_can_and_no_border(name):
    lens = camera(LENSES[name])
    pinhole = pinhole_of("a", lens)
    assert (pinhole.width, pinhole.height, pinhole.center_px) == (WIDTH, HEIGHT, lens.center_px)
    assert pinhole.distorted is None
    assert pinhole.focal_px[0] / pinhole.focal_px[1] == pytest.approx(250 / 240)
    columns, rows = sampled_at(lens.distorted, pinhole)
    assert columns.min() > -0.02
    assert rows.min() > -0.02
    assert columns.max() < WIDTH - 1 + 0.02
    assert rows.max() < HEIGHT - 1 + 0.02
    # A little wider, and it would look past the border; or, where the lens folds back, see a place in the mirror.
    wider = Camera(WIDTH, HEIGHT, tuple(0.97 * f for f in pinhole.focal_px), pinhole.center_px)
    columns, rows = sampled_at(lens.distorted, wider)
    is_out = min(columns.min(), rows.min(), WIDTH - 1 - columns.max(), HEIGHT - 1 - rows.max()) < 0
    by_row, by_column = (np.gradient(seen.astype(float)) for seen in (columns, rows))
    assert is_out or (by_row[1] * by_column[0] <= by_row[0] * by_column[1]).any()


@pytest.mark.parametrize("name", [*LENSES, "fisheye"])
def test_pixels_come_from_where_their_rays_are_projected(name):
    """Maps are OpenCV's, made at once; its projection of single rays, which by-hand values hold, says the same."""
    is_fisheye = name == "fisheye"
    told = (0.05, -0.02, 0.01, -0.005) if is_fisheye else LENSES[name]
    lens = camera(told, (110.0, 110.0), lens=FisheyeModel) if is_fisheye else camera(told)
    pinhole = pinhole_of("a", lens)
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = (np.stack((columns, rows), axis=-1).reshape(-1, 2) - pinhole.center_px) / pinhole.focal_px
    expected = lens.distorted(rays).reshape(HEIGHT, WIDTH, 2)
    np.testing.assert_allclose(np.dstack(sampled_at(lens.distorted, pinhole)), expected, atol=1e-3)
    np.testing.assert_array_equal(
        sampled_at(lambda asked: lens.distorted(asked), pinhole), np.moveaxis(expected.astype(np.float32), -1, 0)
    )


def test_the_longest_image_can_be_undistorted():
    row, where = np.zeros((1, LARGEST_SIDE_PX, 3), np.uint8), np.zeros((1, LARGEST_SIDE_PX), np.float32)
    assert cv2.remap(row, where, where, cv2.INTER_LINEAR).shape == row.shape


def test_a_pinhole_stays_itself():
    plain = Camera(WIDTH, HEIGHT, (200.0, 200.0), (160.0, 120.0))
    assert pinhole_of("a", plain) is plain


@pytest.mark.parametrize(
    ("coefficients", "center_px"), [((1e9, 0, 0, 0, 0), (150.0, 125.0)), ((0.1, 0, 0, 0, 0), (-50.0, 125.0))]
)
def test_what_is_no_lens(coefficients, center_px):
    with pytest.raises(InputError, match="camera front: its distortion maps nothing into the image"):
        pinhole_of("front", camera(coefficients, center_px=center_px))
