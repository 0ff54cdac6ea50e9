"""Pinhole cameras against OpenCV: its projection, its resize, and crops by hand."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from mambaloc.geometry import cropped_intrinsics, project, project_from_world, resized_intrinsics, transform
from mambaloc.types import Pose

K = torch.tensor([[585.0, 0, 320], [0, 570, 240], [0, 0, 1]], dtype=torch.float64)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_world_points_fall_where_opencv_projects_them():
    points_m = random(50, 3)
    for seed in range(5):
        rotation, position_m = Rotation.random(random_state=seed), random(3, seed=seed) + 5
        quaternion = torch.from_numpy(rotation.as_quat(canonical=True)).roll(1)
        pixels = project(transform(Pose(position_m, quaternion).inverse(), points_m), K)
        rvec = rotation.inv().as_rotvec()
        expected = cv2.projectPoints(points_m.numpy(), rvec, -rotation.inv().apply(position_m), K.numpy(), None)[0]
        np.testing.assert_allclose(pixels, expected[:, 0], rtol=1e-9, atol=1e-6)


def test_points_in_front_fall_where_opencv_projects_them_and_none_makes_gradients_infinite():
    rotation, position_m = Rotation.random(random_state=1), random(1, 3) + 5
    quaternion = torch.from_numpy(rotation.as_quat(canonical=True)).roll(1)[None]
    ahead, behind, at_the_lens = torch.tensor([[0.3, -0.2, 2.0], [0.3, 0.2, -2.0], [0.0, 0.0, 0.0]]).double()
    points_m = (
        transform(Pose(position_m, quaternion), torch.stack((ahead, behind, at_the_lens))[None])
    ).requires_grad_()
    pixels, is_ahead = project_from_world(points_m, position_m, quaternion, K[None], near_m=0.1)
    assert is_ahead.tolist() == [[True, False, False]]
    expected = cv2.projectPoints(ahead[None].numpy(), np.zeros(3), np.zeros(3), K.numpy(), None)[0]
    np.testing.assert_allclose(pixels[0, 0].detach(), expected[0, 0], atol=1e-6)
    pixels.sum().backward()
    assert points_m.grad.isfinite().all()


def test_intrinsics_of_a_batch_broadcast_over_its_points():
    points, cameras = (
        random(4, 7, 3) + torch.tensor([0, 0, 5.0]),
        K + torch.arange(4.0)[:, None, None] * K.new_tensor([[1, 0, 2], [0, 3, 4], [0, 0, 0]]),
    )
    singly = torch.stack([project(of, camera) for of, camera in zip(points, cameras, strict=True)])
    torch.testing.assert_close(project(points, cameras[:, None]), singly)


def test_mixed_precision_does_not_round_pixels():
    points = torch.tensor([[0.31234567, 0.2, 2.0], [-0.4, 0.1, 3.0]])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = project(points, K.float())
    assert torch.equal(mixed, project(points, K.float()))


def test_project_is_differentiable():
    points = (random(5, 3) + torch.tensor([0, 0, 4.0])).requires_grad_()
    assert gradcheck(project, (points, K.clone().requires_grad_()))


@pytest.mark.parametrize(("width", "height"), [(320, 240), (128, 96), (640, 480), (341, 256), (1280, 960)])
def test_resized_intrinsics_follow_the_pixel_grid(width, height):
    """The borders of the image, half a pixel outside of its first and last pixel, stay its borders."""
    scaled = resized_intrinsics(K, width / 640, height / 480)
    for pixel, expected in (((-0.5, -0.5), (-0.5, -0.5)), ((639.5, 479.5), (width - 0.5, height - 0.5))):
        ray = torch.linalg.inv(K) @ torch.tensor([*pixel, 1], dtype=torch.float64)
        torch.testing.assert_close(project(ray, scaled), torch.tensor(expected, dtype=torch.float64), atol=1e-4, rtol=0)


@pytest.mark.parametrize(("width", "height"), [(80, 60), (100, 75), (57, 43)])
def test_a_dot_is_found_where_its_resized_intrinsics_project_it(width, height):
    """The centre of mass of a blurred dot in an image that OpenCV resized."""
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    dot = np.exp(-((x - 71.3) ** 2 + (y - 44.8) ** 2) / (2 * 6.0**2))
    resized = cv2.resize(dot, (width, height), interpolation=cv2.INTER_AREA)
    weights = resized / resized.sum()
    found = (weights.sum(0) @ np.arange(width), weights.sum(1) @ np.arange(height))
    camera = torch.tensor([[140.0, 0, 79.5], [0, 140, 59.5], [0, 0, 1]], dtype=torch.float64)
    ray = torch.linalg.inv(camera) @ torch.tensor([71.3, 44.8, 1], dtype=torch.float64)
    pixel = project(ray, resized_intrinsics(camera, width / 160, height / 120))
    np.testing.assert_allclose(found, pixel, atol=0.02)


def test_cropped_intrinsics_shift_each_camera_by_its_corner():
    cameras, before = K.repeat(3, 1, 1), K.repeat(3, 1, 1)
    top, left = torch.tensor([0, 5, 30]), torch.tensor([7, 0, 11])
    cropped = cropped_intrinsics(cameras, top, left)
    point = torch.tensor([0.2, -0.1, 2.0], dtype=torch.float64)
    shift = torch.stack([left, top], dim=-1)
    torch.testing.assert_close(project(point, cropped), project(point, cameras) - shift)
    torch.testing.assert_close(cropped_intrinsics(cameras, 5, 3)[1, :2, 2], K[:2, 2] - K.new_tensor([3, 5]))
    assert torch.equal(cameras, before)


def test_a_pixel_of_the_big_image_maps_into_the_resized_crop():
    """640x480 halved, then cropped at row 8 and column 20, by hand: x' = (x + 0.5) / 2 - 0.5 - 20."""
    small = cropped_intrinsics(resized_intrinsics(K[None], 0.5, 0.5), 8, 20)[0]
    ray = torch.linalg.inv(K) @ torch.tensor([301.0, 155.0, 1], dtype=torch.float64)
    torch.testing.assert_close(project(ray, small), torch.tensor([130.25, 69.25], dtype=torch.float64))
