"""The renderer and its rooms against independent oracles: OpenCV's projection, rays by hand, SciPy's rotations."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.rendering import (
    Room,
    default_intrinsics,
    furnished_room,
    quad,
    render,
    smooth_trajectory,
)

SIZE = (96, 72)
K = default_intrinsics(SIZE)
INSIDE_M = np.array([[-1.25, -1.0, 1.1], [1.25, 1.0, 1.7]])
RED, GREEN, BLUE, WHITE, GREY = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (90, 90, 90)


def flat(color, size=(64, 64)):
    return np.full((*size, 3), color, dtype=np.uint8)


def room_of(*quads):
    return Room(tuple(quads), INSIDE_M)


def camera(seed=0):
    """A pose near the origin that looks roughly along +z, with all angles in play."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", rng.uniform(-20, 20, 3), degrees=True).as_matrix()
    pose[:3, 3] = rng.uniform(-0.3, 0.3, 3)
    return pose


def projected(points_m, pose):
    cam_from_world = np.linalg.inv(pose)
    rvec = Rotation.from_matrix(cam_from_world[:3, :3]).as_rotvec()
    return cv2.projectPoints(np.asarray(points_m, dtype=float), rvec, cam_from_world[:3, 3], K, None)[0][:, 0]


@pytest.fixture(scope="module")
def room():
    return furnished_room(INSIDE_M, seed=0, px_per_m=40)


# The renderer


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("seed", range(4))
def test_marker_appears_where_opencv_projects_it(seed, samples):
    wall = quad((-5, -5, 3), (10, 0, 0), (0, 10, 0), flat(GREY))
    marker = quad((-0.4, -0.3, 2.9), (0.8, 0.1, 0), (-0.1, 0.5, -0.3), flat(RED))
    pose = camera(seed)
    rgb, _ = render(room_of(wall, marker), K, pose, SIZE, samples)
    corners = marker.corner_m + np.array([0 * marker.u_m, marker.u_m, marker.u_m + marker.v_m, marker.v_m])
    outline = projected(corners, pose).astype(np.float32)
    blend_px = 0.01 if samples == 1 else 0.75  # nearer to the outline a pixel's samples may see both colours
    for y, x in np.ndindex(rgb.shape[:2]):
        inside_px = cv2.pointPolygonTest(outline, (x, y), measureDist=True)
        if abs(inside_px) > blend_px:
            assert tuple(rgb[y, x]) == (RED if inside_px > 0 else GREY), (x, y, inside_px)


@pytest.mark.parametrize("seed", range(3))
def test_texture_is_upright_and_sampled_where_opencv_projects_it(seed):
    texture = np.vstack([np.hstack([flat(RED), flat(GREEN)]), np.hstack([flat(BLUE), flat(WHITE)])])
    picture = quad((-0.6, -0.4, 3), (1.2, 0, 0.5), (0, 0.9, -0.2), texture)
    pose = camera(seed)
    rgb, _ = render(room_of(picture), K, pose, SIZE)
    for (s, t), color in {(0.3, 0.3): RED, (0.7, 0.3): GREEN, (0.3, 0.7): BLUE, (0.7, 0.7): WHITE}.items():
        point = picture.corner_m + s * picture.u_m + t * picture.v_m
        x, y = np.round(projected([point], pose)[0]).astype(int)
        assert tuple(rgb[y, x]) == color


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_depth_is_the_ray_plane_distance_along_the_axis(samples):
    floor = quad((-9, 1.2, 12), (18, 0, 0), (0, 0, -24), flat(GREY))  # y = 1.2, below the camera, also behind it
    pose = camera(1)
    _, depth = render(room_of(floor), K, pose, SIZE, samples)
    x, y = 50, 66
    ray = pose[:3, :3] @ np.array([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], 1.0])
    assert depth[y, x] == pytest.approx((1.2 - pose[1, 3]) / ray[1], rel=1e-4)


def test_quad_partly_behind_the_camera_fills_its_part_and_no_more():
    floor = quad((-50, 1, 50), (100, 0, 0), (0, 0, -100), flat(GREEN))
    rgb, depth = render(room_of(floor), K, np.eye(4), SIZE)
    horizon = (SIZE[1] - 1) / 2 + K[1, 1] * 1 / 50
    assert (rgb[int(horizon) + 2 :] == GREEN).all()
    assert not rgb[: int(horizon) - 1].any()
    assert not depth[: int(horizon) - 1].any()
    assert np.isfinite(depth).all()


def test_quads_behind_the_camera_and_backs_are_not_seen():
    behind = quad((-1, -1, -2), (2, 0, 0), (0, 2, 0), flat(RED))
    turned_away = quad((1, -1, 2), (-2, 0, 0), (0, 2, 0), flat(RED))
    rgb, depth = render(room_of(behind, turned_away), K, np.eye(4), SIZE)
    assert not rgb.any()
    assert not depth.any()


@pytest.mark.parametrize("order", [1, -1])
def test_nearer_quad_hides_the_farther_whatever_their_order(order):
    near = quad((-0.5, -0.5, 1), (1, 0, 0), (0, 1, 0), flat(RED))
    far = quad((-5, -5, 2), (10, 0, 0), (0, 10, 0), flat(BLUE))
    rgb, depth = render(room_of(*[near, far][::order]), K, np.eye(4), SIZE)
    assert tuple(rgb[36, 48]) == RED
    assert depth[36, 48] == pytest.approx(1, rel=1e-5)
    assert tuple(rgb[2, 2]) == BLUE


# Rooms and trajectories


def test_room_is_a_function_of_its_seed(room):
    pose = smooth_trajectory(1, 0, INSIDE_M)[0]
    same, other = (furnished_room(INSIDE_M, seed, px_per_m=40) for seed in (0, 1))
    assert all((a.texture == b.texture).all() for a, b in zip(room.quads, same.quads, strict=True))
    assert (render(room, K, pose, SIZE)[0] == render(same, K, pose, SIZE)[0]).all()
    assert (render(room, K, pose, SIZE)[0] != render(other, K, pose, SIZE)[0]).any()


def test_every_direction_shows_texture_and_no_hole(room):
    for pose in smooth_trajectory(36, 5, INSIDE_M, step_deg=10):
        rgb, depth = render(room, K, pose, SIZE)
        assert rgb.std() > 20
        assert depth.min() > 0.05


def test_furniture_stays_out_of_the_free_box(room):
    lower, upper = INSIDE_M
    for q in room.quads:
        corners = q.corner_m + np.array([0 * q.u_m, q.u_m, q.v_m, q.u_m + q.v_m])
        assert (corners.max(axis=0) < lower).any() or (corners.min(axis=0) > upper).any()


def test_trajectory_is_smooth_upright_and_stays_inside():
    poses = smooth_trajectory(300, 3, INSIDE_M)
    assert ((poses[:, :3, 3] >= INSIDE_M[0]) & (poses[:, :3, 3] <= INSIDE_M[1])).all()
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    assert np.allclose(rotations.as_matrix(), poses[:, :3, :3])  # orthonormal, right-handed
    assert (poses[:, 2, 1] < -0.8).all()  # the camera's y axis points down
    step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    step_deg = np.degrees((rotations[:-1].inv() * rotations[1:]).magnitude())
    assert 0.005 < np.median(step_m) < 0.03
    assert step_m.max() < 0.06
    assert 0.5 < np.median(step_deg) < 1.5
    assert step_deg.max() < 3
    assert not np.allclose(poses, smooth_trajectory(300, 4, INSIDE_M))
