from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mambaloc.geometry import grid_rays
from mambaloc.losses import CellWeights
from mambaloc.losses.cells import points_of_cells
from mambaloc.types import CellPrediction, PoseBatch, PosePrediction

SIZE, GRID = (48, 64), (3, 4)
K = np.array([[60.0, 0, 31.5], [0, 55.0, 23.5], [0, 0, 1]])


def batch(points_px=(), depths_m=(), count=2):
    """Cameras anywhere; each sees the same points, given by their pixels and depths."""
    rng = np.random.default_rng(0)
    turned, position_m = Rotation.random(count, rng=rng), rng.normal(size=(count, 3))
    pixels = np.hstack((np.reshape(points_px, (-1, 2)), np.ones((len(depths_m), 1))))
    points_cam_m = (np.linalg.inv(K) @ pixels.T).T * np.reshape(depths_m, (-1, 1))
    points_m = np.stack([r.apply(points_cam_m) + p for r, p in zip(turned, position_m, strict=True)])
    return PoseBatch(
        torch.zeros(count, 3, *SIZE),
        torch.from_numpy(position_m),
        torch.from_numpy(turned.as_quat(canonical=True, scalar_first=True)),
        torch.arange(count),
        points_m=torch.from_numpy(points_m),
        intrinsics=torch.from_numpy(K).expand(count, 3, 3),
    ), turned


def perfect(target, turned):
    rays_cam = grid_rays(target.intrinsics, SIZE, GRID)
    rays_world = np.stack([r.apply(c) for r, c in zip(turned, rays_cam.numpy(), strict=True)])
    votes_m = target.position_m[:, None].expand(-1, 12, -1)
    weights = torch.full((len(rays_cam), 12), 1 / 12)
    cells = CellPrediction(rays_cam, torch.from_numpy(rays_world), votes_m, None, weights, weights, GRID)
    return PosePrediction(target.position_m, target.quaternion, cells=cells)


def test_a_perfect_prediction_costs_the_weights_alone():
    target, turned = batch()
    target = replace(target, points_m=None)
    assert CellWeights()(perfect(target, turned), target).item() == pytest.approx(-2.0 - 3.5, abs=1e-5)


def test_each_distance_counts_as_its_weight_says():
    target, turned = batch()
    target, loss = replace(target, points_m=None), CellWeights(s_position=0.0, s_rotation=0.0, cell_weight=0.5)
    prediction = perfect(target, turned)
    moved = replace(prediction, position_m=prediction.position_m + torch.tensor([0.0, 3.0, 4.0]))
    assert loss(moved, target).item() == pytest.approx(5.0, abs=1e-5)
    cells = replace(prediction.cells, position_m=prediction.cells.position_m + torch.tensor([0.0, 0.3, 0.4]))
    assert loss(replace(prediction, cells=cells), target).item() == pytest.approx(0.5 * 0.5, abs=1e-5)
    reversed_ = replace(prediction.cells, rays_world=-prediction.cells.rays_world)
    assert loss(replace(prediction, cells=reversed_), target).item() == pytest.approx(0.5 * 2 / 2, abs=1e-5)
    assert loss(replace(prediction, quaternion=-prediction.quaternion), target).item() == pytest.approx(0, abs=1e-5)


def test_a_cell_has_the_point_nearest_to_its_center():
    # cells are 16 px wide: the first two lie in the first cell, the third in the last, the others outside or behind
    pixels, depths_m = [(3, 3), (7, 8), (60, 40), (64.6, 20), (30, -0.6), (30, 20)], [2, 3, 4, 5, 6, -1]
    target, _ = batch(pixels, depths_m)
    missing = torch.full((2, 1, 3), torch.nan, dtype=torch.float64)
    target = replace(target, points_m=torch.cat((missing, target.points_m), dim=1))
    points_m, is_seen = points_of_cells(target, GRID)
    assert is_seen.sum(dim=1).tolist() == [2, 2]
    torch.testing.assert_close(points_m[:, 0], target.points_m[:, 2])
    torch.testing.assert_close(points_m[:, 11], target.points_m[:, 3])


def test_points_are_compared_where_there_are_any():
    target, turned = batch([(7, 8)], [3])
    prediction, loss = perfect(target, turned), CellWeights(s_position=0.0, s_rotation=0.0, point_weight=0.5)
    without = loss(prediction, target).item()
    said_m = target.points_m + torch.tensor([0.0, 0.6, 0.8])
    cells = replace(prediction.cells, points_m=said_m.expand(-1, 12, -1))
    assert loss(replace(prediction, cells=cells), target).item() == pytest.approx(without + 0.5, abs=1e-5)
    no_points = replace(target, points_m=None)
    assert loss(replace(prediction, cells=cells), no_points).item() == pytest.approx(without, abs=1e-5)


def test_a_cell_counts_as_much_as_it_shows_of_the_scene():
    target, turned = batch()
    holes = torch.zeros(2, *SIZE, dtype=torch.bool)
    holes[0, :, :16], holes[1, :8, :16] = True, True  # a column of cells; and half of the first cell
    target, loss = replace(target, points_m=None, holes=holes), CellWeights(s_position=0.0, s_rotation=0.0)
    prediction, moved_m = perfect(target, turned), torch.zeros(2, 12, 3)
    moved_m[:, 0, 0] = 7.0  # the first cell of both
    cells = replace(prediction.cells, position_m=prediction.cells.position_m + moved_m)
    assert loss(replace(prediction, cells=cells), target).item() == pytest.approx(7.0 * 0.5 / (9 + 11.5), abs=1e-4)


def test_a_system_without_cells_is_an_error():
    target, turned = batch()
    with pytest.raises(ValueError, match="needs a dense head"):
        CellWeights()(replace(perfect(target, turned), cells=None), target)
