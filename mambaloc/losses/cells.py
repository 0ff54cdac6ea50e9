"""The loss of a dense head: of the solved pose, and of what each cell says."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mambaloc.geometry import project_from_world, rotate
from mambaloc.losses.weighted import pose_distances, weighed
from mambaloc.types import CellPrediction, PoseBatch, PosePrediction

_NEAR_M = 1e-6  # of a scene in any unit, all that lies in front of the camera


class CellWeights(nn.Module):
    """Learned homoscedastic weights of distances, those of the solved pose plus those of its cells.

    A cell's distances are of its guess of the camera's centre, in metres, and half of that between the direction in
    which it looks and the true one, which for small angles is the distance of unit quaternions. A cell that says a
    scene point is compared with the true point nearest to its centre, where the batch has one in the cell; its distance
    counts as one of position. A cell in a hole of a synthetic view counts as much as it shows of the scene.

    Args:
        s_position: initial log-variance of position.
        s_rotation: initial log-variance of rotation.
        cell_weight: what the cells' mean distances count beside the pose's.
        point_weight: what that of scene points counts beside the position's.
    """

    def __init__(
        self, s_position: float = -2.0, s_rotation: float = -3.5, cell_weight: float = 1.0, point_weight: float = 1.0
    ) -> None:
        super().__init__()
        if min(cell_weight, point_weight) < 0:
            raise ValueError(f"cell_weight {cell_weight} and point_weight {point_weight} must be 0 or more")
        self.s_position = nn.Parameter(torch.tensor(float(s_position)))
        self.s_rotation = nn.Parameter(torch.tensor(float(s_rotation)))
        self.cell_weight, self.point_weight = float(cell_weight), float(point_weight)

    def no_weight_decay(self) -> set[str]:
        """Names of the parameters that an optimiser must not decay."""
        return {"s_position", "s_rotation"}

    def forward(self, prediction: PosePrediction, target: PoseBatch) -> Tensor:
        """Weigh the distances; a scalar.

        Raises:
            ValueError: for a prediction without cells.
        """
        cells = prediction.cells
        if cells is None:
            raise ValueError("loss cells: needs a dense head; choose learned_weights for other systems")
        position, rotation = pose_distances(prediction, target, "l2", nearest_sign=True)
        if self.cell_weight:
            share = _share_of_cells(cells, target)
            offset_m = cells.position_m - target.position_m[:, None]
            distance_m = torch.linalg.vector_norm(offset_m, dim=-1)
            position = position + self.cell_weight * (share * distance_m).sum()
            rotation = rotation + self.cell_weight * _direction_distance(cells, target, share)
        if self.point_weight and cells.points_m is not None and target.points_m is not None:
            position = position + self.point_weight * _point_distance(cells.points_m, cells.grid, target)
        return weighed(position, self.s_position) + weighed(rotation, self.s_rotation)


def _share_of_cells(cells: CellPrediction, target: PoseBatch) -> Tensor:
    """What each cell counts in a mean, (B, N) or one number: as much as it shows of the scene."""
    count = cells.rays_cam[..., 0]
    if target.holes is None:
        return count.new_full((), 1 / count.numel())  # made on the device, which nothing waits for
    shown = 1 - F.adaptive_avg_pool2d(target.holes[:, None].to(count), cells.grid).flatten(1)
    return shown / shown.sum().clamp_min(1)


def _direction_distance(cells: CellPrediction, target: PoseBatch, share: Tensor) -> Tensor:
    if cells.rays_world is None:  # the cells say quaternions, of which the loss sees the mean
        return cells.position_m.new_zeros(())
    true = rotate(target.quaternion[:, None], cells.rays_cam)
    return (share * torch.linalg.vector_norm(cells.rays_world - true, dim=-1)).sum() / 2


def _point_distance(predicted_m: Tensor, grid: tuple[int, int], target: PoseBatch) -> Tensor:
    true_m, is_seen = points_of_cells(target, grid)
    distance_m = torch.linalg.vector_norm(predicted_m - true_m, dim=-1)
    return torch.where(is_seen, distance_m, 0.0).sum() / is_seen.sum().clamp_min(1)


def points_of_cells(target: PoseBatch, grid: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Of the scene points that a frame sees in each cell, the one nearest to the cell's centre.

    Args:
        target: with ``points_m`` and ``intrinsics``.
        grid: rows and columns, which divide the image evenly.

    Returns:
        (B, N, 3) in metres, 0 where it is unknown, and whether it is known, (B, N).
    """
    assert target.points_m is not None
    assert target.intrinsics is not None
    size = target.image.shape[-2:]
    is_point = target.points_m.isfinite().all(dim=-1)
    points_m = torch.where(is_point[..., None], target.points_m, 0.0)
    points_px, is_ahead = project_from_world(points_m, target.position_m, target.quaternion, target.intrinsics, _NEAR_M)
    sides = torch.tensor((grid[1] / size[1], grid[0] / size[0]), device=points_px.device)
    place = (points_px + 0.5) * sides  # in cells
    column, row = place.floor().unbind(dim=-1)
    is_inside = is_point & is_ahead & (row >= 0) & (row < grid[0]) & (column >= 0) & (column < grid[1])
    cell = torch.where(is_inside, row * grid[1] + column, float(grid[0] * grid[1])).long()  # the last one is for strays
    far = torch.where(is_inside, (place - place.floor() - 0.5).square().sum(dim=-1), torch.inf)
    nearest = far.new_full((len(cell), grid[0] * grid[1] + 1), torch.inf).scatter_reduce(1, cell, far, "amin")
    is_nearest = is_inside & (far == nearest.gather(1, cell))
    found_m = points_m.new_zeros(len(cell), nearest.shape[1], 3)
    found_m[is_nearest.nonzero()[:, 0], cell[is_nearest]] = points_m[is_nearest]
    return found_m[:, :-1], nearest[:, :-1].isfinite()
