"""A dense head and its cells: every cell of the feature map answers, and the pose is solved from all answers."""

from __future__ import annotations

from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mambaloc.geometry import align_directions, canonical, intersect_rays, rotate
from mambaloc.nn.heads import PositionScale, RegressionHead
from mambaloc.types import CellPrediction, PosePrediction

CellRotation = Literal["procrustes", "quaternion"]
"""What a cell says of the rotation: the direction of the world in which it looks, or the camera's quaternion."""

CellPosition = Literal["votes", "points"]
"""What a cell says of the position: the camera's centre; or that, and the scene point that it sees."""

_VOTES_WEIGHT = 0.05  # of the mean vote, beside rays through points whose weights sum to 1


class CellDetail(nn.Module):
    """Cells of the finest feature map: what finer maps show there, beside the context that coarse cells have.

    Args:
        channels: of all finer maps together.
        grid: rows and columns of the finest map.
        dim: width of the cells.
        hidden: hidden width of the MLP that joins the two.

    Shape:
        context (B, dim, h, w), maps of (B, C, H, W), the finest first -> (B, dim, H, W) of the first map.
    """

    def __init__(self, channels: int, grid: tuple[int, int], dim: int, hidden: int) -> None:
        super().__init__()
        self.project = nn.Linear(channels, dim)
        self.places = nn.Parameter(torch.zeros(grid[0] * grid[1], dim))  # attention knows where; values do not say it
        self.norm = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, hidden), nn.GELU(), nn.Linear(hidden, dim))
        self.norm_out = nn.LayerNorm(dim)

    def forward(self, context_BDhw: Tensor, finer: list[Tensor]) -> Tensor:
        """Add detail to the context, and let an MLP of each cell join them, around a residual."""
        size = finer[0].shape[-2:]
        maps_BCHW = torch.cat([_resized(each, size) for each in finer], dim=1)
        context_BND = _resized(context_BDhw, size).flatten(2).mT
        cells_BND = context_BND + self.project(maps_BCHW.flatten(2).mT) + self.places
        cells_BND = self.norm_out(cells_BND + self.mlp(self.norm(cells_BND)))
        return cells_BND.mT.unflatten(-1, size)


def _resized(maps_BCHW: Tensor, size: torch.Size) -> Tensor:
    return F.interpolate(maps_BCHW, size, mode="bilinear", align_corners=False)


class CellHead(nn.Module):
    """From a feature a cell and branch to a pose.

    With ``procrustes`` each cell says in which direction of the world it looks, and the rotation is the one that turns
    the cells' directions in the camera, known from its intrinsics, into these best. With ``votes`` the position is the
    weighted mean of the cells' guesses. With ``points`` each also says the scene point that it sees, and the position
    is where the rays through these points meet, with the mean vote as a weak prior. The weights are learned: a softmax
    over cells a branch.

    Args:
        dim: width of both features.
        rotation: ``procrustes`` or ``quaternion``, the ablation's weighted mean of quaternions.
        position: ``votes`` or ``points``.
        hidden: hidden width of each branch's MLP; None for a linear layer.
        scenes: how many scenes the network knows; each has outputs and a position scale of its own.

    Shape:
        (B, N, dim), (B, N, dim), (B, N, 3) unit directions of the cells in the camera, their grid, and with several
        scenes which one each image is of, (B,) -> :class:`~mambaloc.types.PosePrediction`.

    Raises:
        ValueError: for an unknown ``rotation`` or ``position``.
    """

    def __init__(
        self,
        dim: int,
        rotation: CellRotation = "procrustes",
        position: CellPosition = "votes",
        hidden: int | None = None,
        scenes: int = 1,
    ) -> None:
        super().__init__()
        if rotation not in get_args(CellRotation):
            raise ValueError(f"rotation is 'procrustes' or 'quaternion', not {rotation!r}")
        if position not in get_args(CellPosition):
            raise ValueError(f"position is 'votes' or 'points', not {position!r}")
        self.is_procrustes, self.sees_points = rotation == "procrustes", position == "points"
        self.rotation = RegressionHead(dim, hidden, scenes * ((3 if self.is_procrustes else 4) + 1))
        self.position = RegressionHead(dim, hidden, scenes * (3 + 1))
        if self.sees_points:
            self.points = RegressionHead(dim, hidden, scenes * (3 + 1))
        self.position_scale = PositionScale(scenes)
        self.scenes = scenes

    def forward(
        self,
        position_BND: Tensor,
        rotation_BND: Tensor,
        rays_cam: Tensor,
        grid: tuple[int, int],
        scene: Tensor | None = None,
    ) -> PosePrediction:
        """Solve the pose, in float32 even under autocast."""
        rotation, rotation_weights = self._answers(self.rotation(rotation_BND), scene)
        votes, position_weights = self._answers(self.position(position_BND), scene)
        rays_world = None
        if self.is_procrustes:
            rays_world = F.normalize(rotation, dim=-1)
            quaternion = align_directions(rays_cam, rays_world, rotation_weights)
        else:
            quaternion = canonical((rotation_weights[..., None] * canonical(rotation)).sum(dim=1))
        position, points = (position_weights[..., None] * votes).sum(dim=1), None
        if self.sees_points:
            points, position_weights = self._answers(self.points(position_BND), scene)
            directions = rotate(quaternion[:, None], rays_cam)
            position = intersect_rays(directions, points, position_weights, position, _VOTES_WEIGHT)
        metres = self.position_scale
        cells = CellPrediction(
            rays_cam,
            rays_world,
            metres(votes, scene),
            None if points is None else metres(points, scene),
            rotation_weights,
            position_weights,
            grid,
        )
        return PosePrediction(metres(position, scene), quaternion, cells=cells)

    def _answers(self, outputs_BNO: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor]:
        """Split the outputs of each image's scene into values, (B, N, O - 1), and weights that sum to 1, (B, N)."""
        if scene is not None:
            each_BNSO = outputs_BNO.unflatten(-1, (self.scenes, -1))
            _, cells, _, outputs = each_BNSO.shape
            row = scene.view(-1, 1, 1, 1).expand(-1, cells, 1, outputs)
            outputs_BNO = each_BNSO.gather(2, row).squeeze(2)
        values, logits = outputs_BNO[..., :-1], outputs_BNO[..., -1]
        return values, torch.softmax(logits, dim=-1)
