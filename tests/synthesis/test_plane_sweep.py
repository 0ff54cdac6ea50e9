"""Depth from images against the renderer's exact depth, and each step against loops or values by hand."""

import itertools

import numpy as np
import pytest
import torch

from mambaloc.errors import InputError
from mambaloc.synthesis import PlaneSweep, depth_from_images
from mambaloc.synthesis.depth_from_images import range_from_images, range_of_points, spread_rows
from mambaloc.synthesis.plane_sweep import aggregated, best_half, between_planes

ROWS = np.array([5, 20, 35, 50])


@pytest.fixture(scope="module")
def denser_walk(shoot_room):
    from mambaloc.rendering import embedded_walk

    return shoot_room(embedded_walk(120, 1, start_deg=0.0, step_deg=2.4))


def within(found, exact, share):
    known = np.isfinite(found) & np.isfinite(exact)
    return (np.abs(found / exact - 1)[known] < share).mean()


@pytest.fixture(scope="module")
def found(denser_walk):
    walk = denser_walk
    return PlaneSweep(walk.images, walk.intrinsics, walk.world_from_cam, (1.0, 6.0)).depth_m(ROWS)


def test_depth_is_that_of_the_renderer(found, denser_walk):
    assert np.isfinite(found).all()
    assert within(found, denser_walk.depth_m[ROWS], 0.05) > 0.8
    assert within(found, denser_walk.depth_m[ROWS], 0.10) > 0.92


def test_depth_lies_between_planes(found, denser_walk):
    """64 planes between 1 m and 6 m are 5 % of the depth apart at 4 m; the median must be clearly finer."""
    assert np.median(np.abs(found / denser_walk.depth_m[ROWS] - 1)) < 0.02


def test_unit_of_the_poses_does_not_matter(found, denser_walk):
    poses = denser_walk.world_from_cam.copy()
    poses[:, :3, 3] *= 70
    sweep = PlaneSweep(denser_walk.images, denser_walk.intrinsics, poses, (70.0, 420.0))
    np.testing.assert_allclose(sweep.depth_m(ROWS[:1])[0] / 70, found[0], rtol=1e-3)


def test_picture_without_neighbours_has_no_depth(denser_walk):
    poses = denser_walk.world_from_cam.copy()
    poses[0, :3, 3] += 100
    sweep = PlaneSweep(denser_walk.images, denser_walk.intrinsics, poses, (1.0, 6.0))
    assert sweep.neighbours(0) == []
    assert np.isnan(sweep.depth_m(np.array([0]))).all()


def test_pictures_alone_bound_the_depth(denser_walk):
    walk = denser_walk
    near_m, far_m = range_from_images(walk.images, walk.intrinsics, walk.world_from_cam)
    nearest, farthest = np.nanquantile(walk.depth_m, [0.01, 0.99])
    assert nearest / 2.5 < near_m < nearest * 1.05
    assert farthest * 0.95 < far_m < farthest * 2.5


def test_what_several_pictures_confirm_is_right(denser_walk):
    walk = denser_walk.select(np.arange(40))
    points_m = np.random.default_rng(0).uniform((-3, -3, 0), (3, 3, 2.5), (4000, 3))
    found = depth_from_images(walk.images, walk.intrinsics, walk.world_from_cam, points_m, key_frames=10)
    rows = [int(np.abs(walk.world_from_cam - pose).sum(axis=(1, 2)).argmin()) for pose in found.world_from_cam]
    assert np.isfinite(found.depth_m).mean() > 0.4
    assert within(found.depth_m, walk.depth_m[rows], 0.05) > 0.87


def test_poses_that_do_not_fit_the_pictures_are_refused(denser_walk):
    walk = denser_walk.select(np.arange(0, 120, 3))
    shuffled = np.random.default_rng(0).permutation(len(walk))
    with pytest.raises(InputError, match="Check poses and cameras, or do without views"):
        depth_from_images(
            walk.images[shuffled], walk.intrinsics, walk.world_from_cam, np.array([[0, 0, 1.0], [3, 3, 1]]), 8
        )


def test_aggregation_is_that_of_plain_loops():
    volume = np.random.default_rng(0).uniform(size=(5, 6, 7))
    small, large = 0.1, 0.3
    total = np.zeros_like(volume)
    for step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        costs = {}
        order = sorted(itertools.product(range(6), range(7)), key=lambda at: at[0] * step[0] + at[1] * step[1])
        for y, x in order:
            before = costs.get((y - step[0], x - step[1]))
            here = volume[:, y, x].copy()
            if before is not None:
                jumps = np.abs(np.arange(5)[:, None] - np.arange(5))
                penalty = np.where(jumps == 0, 0, np.where(jumps == 1, small, large))
                here += (before + penalty).min(axis=1) - before.min()
            costs[y, x] = here
            total[:, y, x] += here / 4
    done = aggregated(torch.from_numpy(volume), small, large)
    np.testing.assert_allclose(done.numpy(), total, rtol=1e-9)


def test_best_half_of_the_known_costs():
    nan = torch.nan
    costs = torch.tensor([[4.0, nan, nan], [1.0, 3.0, nan], [2.0, 5.0, nan], [9.0, 1.0, nan]])
    assert best_half(costs).tolist() == [1.5, 2.0, 1.0]  # of 1 2 4 9; of 1 3 5; of nothing


def test_least_cost_lies_at_the_vertex_of_the_parabola():
    inverse = torch.linspace(0.2, 1.0, 9)
    volume = ((inverse - 0.57) ** 2)[:, None, None]
    assert between_planes(volume, inverse).item() == pytest.approx(0.57, abs=1e-6)


def test_range_of_points_is_of_what_the_camera_sees():
    depths = np.linspace(1, 3, 201)
    seen = np.stack((np.zeros(201), np.zeros(201), depths), axis=1)
    unseen = np.array([[50.0, 0, 2], [0, 0, -7]])
    intrinsics = np.array([[[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]])
    near_m, far_m = range_of_points(np.vstack((seen, unseen)), intrinsics, np.eye(4)[None], (30, 40))
    assert (near_m, far_m) == pytest.approx((1.02 / 1.3, 2.98 * 1.3))


def test_key_frames_are_spread():
    poses = np.tile(np.eye(4), (100, 1, 1))
    poses[:, 0, 3] = np.r_[np.full(90, 0.0), np.linspace(1, 10, 10)]
    rows = spread_rows(poses, 1.0, 6)
    places = poses[rows, 0, 3]
    assert (places[0], places[-1]) == (0, 10)
    assert np.diff(places).max() <= 3  # in order of rows they would all be at 0
    assert spread_rows(poses[:3], 1.0, 6).tolist() == [0, 1, 2]  # at one place, and none twice
