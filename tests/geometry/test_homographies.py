"""Views of turned and zoomed cameras: against OpenCV's warp, SciPy's rotations, and rays worked out point by point."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mambaloc.geometry import rotation_homography, warped

SIZE, NEW_SIZE = (60, 80), (48, 56)  # heights and widths
K = np.array([[[64.0, 0, 39.5], [0, 66, 29.5], [0, 0, 1]], [[90.0, 0, 35], [0, 90, 33], [0, 0, 1]]])
NEW_K = np.array([[[70.0, 0, 27.5], [0, 72, 23.5], [0, 0, 1]], [[60.0, 0, 30], [0, 61, 20], [0, 0, 1]]])
TURNS = Rotation.from_rotvec([[8, -12, 20], [-9, 5, -25]], degrees=True)


def homography(dtype: torch.dtype = torch.float64) -> torch.Tensor:
    matrices = (K, TURNS.as_matrix(), NEW_K)
    return rotation_homography(*(torch.from_numpy(each).to(dtype) for each in matrices))


def picture(size: tuple[int, int] = SIZE) -> np.ndarray:
    """Waves of a few pixels, (2, H, W, 3), between 0.2 and 1: black is nowhere but beyond the border."""
    y, x = np.indices(size)
    waves = [np.sin(x * a + y * b) for a, b in ((0.4, 0.1), (0.1, -0.5), (0.3, 0.3))]
    return np.stack([0.6 + 0.4 * np.stack(waves, axis=-1), 0.6 - 0.4 * np.stack(waves[::-1], axis=-1)])


def test_a_pixel_looks_along_one_ray_from_either_camera():
    rays = np.array([[0.1, -0.2, 1.0], [-0.3, 0.05, 1.0], [0.0, 0.0, 1.0]])  # of the turned camera
    for row, turn in enumerate(TURNS):
        in_new = rays @ NEW_K[row].T
        seen = turn.apply(rays) @ K[row].T  # the same rays in the other camera's axes
        found = in_new @ homography()[row].numpy().T
        np.testing.assert_allclose(found / found[:, 2:], seen / seen[:, 2:], atol=1e-9)


def test_it_is_the_product_of_three_matrices():
    expected = K @ TURNS.as_matrix() @ np.linalg.inv(NEW_K)
    np.testing.assert_allclose(homography(), expected, atol=1e-12)
    np.testing.assert_allclose(homography(torch.float32), expected, atol=2e-5)


def test_the_same_camera_turned_by_nothing_changes_nothing():
    image = torch.from_numpy(picture()).permute(0, 3, 1, 2)
    nothing = rotation_homography(torch.from_numpy(K), torch.eye(3).double().repeat(2, 1, 1), torch.from_numpy(K))
    np.testing.assert_allclose(warped(image, nothing, SIZE), image, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pictures_are_those_that_opencv_warps(dtype):
    """Border included: black beyond, and half a pixel inside of it a blend."""
    pictures = picture()
    found = warped(torch.from_numpy(pictures).permute(0, 3, 1, 2).to(dtype), homography(dtype), NEW_SIZE)
    assert found.shape == (2, 3, *NEW_SIZE)
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    for row, image in enumerate(pictures):
        expected = cv2.warpPerspective(image, homography()[row].numpy(), NEW_SIZE[::-1], flags=how)
        black = (expected == 0).all(axis=-1)
        assert 50 < black.sum() < black.size / 2
        np.testing.assert_allclose(found[row].permute(1, 2, 0), expected, atol=0.02)  # OpenCV rounds to 1/32 pixel
        beyond = cv2.erode(black.astype(np.uint8), np.ones((3, 3))).astype(bool)
        assert not found[row].numpy()[:, beyond].any()


def test_nothing_is_seen_of_what_lies_behind():
    """Turned by 100 degrees, a wide camera sees a part of the image at its side, and no mirror image of it."""
    wide = torch.tensor([[[10.0, 0, 39.5], [0, 10, 29.5], [0, 0, 1]]], dtype=torch.float64)
    turn = torch.from_numpy(Rotation.from_euler("y", 100, degrees=True).as_matrix()[None])
    look_up = rotation_homography(wide, turn, wide)
    found = warped(torch.ones(1, 1, *SIZE, dtype=torch.float64), look_up, SIZE)[0, 0].numpy()
    x, y = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
    rays = np.stack([(x - 39.5) / 10, (y - 29.5) / 10, np.ones(SIZE)], axis=-1) @ turn[0].numpy().T
    depth = np.where(rays[..., 2] > 0, rays[..., 2], np.nan)
    pixel = 10 * rays[..., :2] / depth[..., None] + (39.5, 29.5)
    inside = ((pixel >= 0) & (pixel <= (79, 59))).all(axis=-1)
    assert 20 < inside.sum() < inside.size / 2
    np.testing.assert_allclose(found[inside], 1)
    assert found[~((pixel > -1) & (pixel < (80, 60))).all(axis=-1)].max() == 0
