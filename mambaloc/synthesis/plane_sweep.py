"""Depth from posed images alone: plane sweep (Collins 1996) with semi-global aggregation (Hirschmuller 2008).

Each image is compared with neighbours warped through planes at evenly spaced inverse depths. Colours are normalised
by their neighbourhood's mean and deviation, the best half of the neighbours counts (the others do not see the surface),
and costs are aggregated along rows and columns, so that depth without texture follows from what surrounds it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mambaloc.console import progress
from mambaloc.synthesis.posed_depth import Floats

_LARGEST_COST = 1.5  # deviations; beyond, pixels do not show the same
_NOISE = 4.0  # grey levels, standard deviation
_FARTHEST_TURN_DEG = 25.0
_TYPICAL_TURN_DEG = 15.0


@dataclass(frozen=True)
class SweepSettings:
    """How depth is searched.

    Args:
        planes: at evenly spaced inverse depths.
        neighbours: images that each is compared with, at most.
        baseline: between them, in median depths, at best.
        window_px: side of the squares over which colours are normalised and compared.
        small_step: penalty of a step to the next plane between neighbouring pixels, in deviations.
        large_step: of any larger step.
    """

    planes: int = 64
    neighbours: int = 8
    baseline: float = 0.15
    window_px: int = 3
    small_step: float = 0.2
    large_step: float = 1.6


class PlaneSweep:
    """Depth of images from their neighbours.

    Args:
        images: (N, 3, h, w) uint8.
        intrinsics: (N, 3, 3) in pixels of the images.
        world_from_cam: (N, 4, 4).
        range_m: nearest and farthest depth.
        settings: of the search.
        device: that searches.
    """

    def __init__(
        self,
        images: NDArray[np.uint8],
        intrinsics: Floats,
        world_from_cam: Floats,
        range_m: tuple[float, float],
        settings: SweepSettings | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.settings = settings or SweepSettings()
        self.images, self.intrinsics, self.world_from_cam = images, intrinsics, world_from_cam
        self.device = torch.device(device)
        self.scale_m = 2 / (1 / range_m[0] + 1 / range_m[1])
        self._inverse = torch.linspace(1 / range_m[1], 1 / range_m[0], self.settings.planes, device=self.device)

    def depth_m(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Depth of some images, (R, h, w); NaN where they have no neighbours."""
        found = [self._depth_of(row) for row in progress(rows.tolist(), "depth", len(rows))]
        return torch.stack(found).cpu().numpy()

    def neighbours(self, row: int) -> list[int]:
        """Images that see an image's surfaces from beside it, the best first, each from a place of its own."""
        position_m, forward = self.world_from_cam[:, :3, 3], self.world_from_cam[:, :3, 2]
        offset = np.linalg.norm(position_m - position_m[row], axis=1) / self.scale_m
        turn_deg = np.degrees(np.arccos(np.clip(forward @ forward[row], -1, 1)))
        best = self.settings.baseline
        penalty = np.abs(np.log(np.maximum(offset, 1e-9) / best)) + (turn_deg / _TYPICAL_TURN_DEG) ** 2
        penalty[(turn_deg > _FARTHEST_TURN_DEG) | (offset < best / 5) | (offset > 5 * best)] = np.inf
        chosen: list[int] = []
        for other in np.argsort(penalty, kind="stable").tolist():
            if len(chosen) == self.settings.neighbours or not np.isfinite(penalty[other]):
                break
            steps = np.linalg.norm(position_m[chosen] - position_m[other], axis=1) / self.scale_m
            if (steps > best / 4).all():
                chosen.append(other)
        return chosen

    def _depth_of(self, row: int) -> Tensor:
        others = self.neighbours(row)
        if not others:
            return torch.full(self.images.shape[2:], torch.nan, device=self.device)
        reference, *neighbours = self._normalized([row, *others])
        costs = [self._cost(reference, row, image, other) for image, other in zip(neighbours, others, strict=True)]
        volume = best_half(torch.stack(costs))
        volume = aggregated(volume, self.settings.small_step, self.settings.large_step)
        return 1 / between_planes(volume, self._inverse)

    def _normalized(self, rows: list[int]) -> Tensor:
        """Colours in deviations from the mean around each pixel, (R, 3, h, w)."""
        colors = torch.from_numpy(self.images[rows]).to(self.device, torch.float32)
        mean = self._around(colors)
        variance = (self._around(colors * colors) - mean * mean).clamp(min=0)
        return (colors - mean) / (variance + _NOISE**2).sqrt()

    def _cost(self, reference: Tensor, row: int, image: Tensor, other: int) -> Tensor:
        """How badly a neighbour, warped through each plane, fits an image, (D, h, w); NaN where it does not see."""
        height, width = reference.shape[1:]
        other_from_cam = np.linalg.inv(self.world_from_cam[other]) @ self.world_from_cam[row]
        matrix = self.intrinsics[other] @ other_from_cam[:3, :3] @ np.linalg.inv(self.intrinsics[row])
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        pixels = torch.stack((x, y, torch.ones_like(x))).flatten(1).to(self.device, torch.float32)
        shift = self._tensor(self.intrinsics[other] @ other_from_cam[:3, 3])
        seen = (self._tensor(matrix) @ pixels) + self._inverse[:, None, None] * shift[:, None]  # (D, 3, h * w)
        z = seen[:, 2]
        size = torch.tensor((width, height), device=self.device)[:, None]
        place = (2 * seen[:, :2] / z[:, None].clamp(min=1e-6) + 1) / size - 1
        is_seen = (z > 1e-6) & (place.abs() <= 1).all(dim=1)
        grid = place.transpose(1, 2).reshape(1, -1, width, 2)
        warped = F.grid_sample(image[None], grid, padding_mode="border", align_corners=False)
        off = (warped.reshape(3, -1, height, width) - reference[:, None]).abs_().mean(dim=0).clamp_(max=_LARGEST_COST)
        return self._around(off[:, None])[:, 0].masked_fill_(~is_seen.reshape(off.shape), torch.nan)

    def _around(self, values: Tensor) -> Tensor:
        side = self.settings.window_px
        rows = F.avg_pool2d(values, (1, side), 1, (0, side // 2), count_include_pad=False)
        return F.avg_pool2d(rows, (side, 1), 1, (side // 2, 0), count_include_pad=False)

    def _tensor(self, values: Floats) -> Tensor:
        return torch.from_numpy(values).to(self.device, torch.float32)


def best_half(costs: Tensor) -> Tensor:
    """Mean of the smaller half of the costs that are not NaN; 1 where all are NaN; (K, ...) -> (...)."""
    smallest = [torch.full_like(costs[0], torch.inf) for _ in range((len(costs) + 1) // 2)]
    for cost in costs.nan_to_num(torch.inf):  # inserted into place one by one: sorting takes longer
        for rank, kept in enumerate(smallest):
            smallest[rank], cost = torch.minimum(kept, cost), torch.maximum(kept, cost)
    known = costs.isfinite().sum(dim=0)
    half = (known + 1) // 2
    total = sum((torch.where(half > rank, kept, 0) for rank, kept in enumerate(smallest)), torch.zeros_like(costs[0]))
    return torch.where(known > 0, total / half.clamp(min=1), 1.0)


def aggregated(volume: Tensor, small_step: float, large_step: float) -> Tensor:
    """Costs (D, h, w) plus the least costs of paths that lead to each pixel from all four sides, smooth in depth."""
    total = torch.zeros_like(volume)
    for order in ((1, 0, 2), (2, 0, 1)):  # lines first, then planes
        lines = volume.permute(order).contiguous()
        back = tuple(np.argsort(order).tolist())
        total += _along(lines, small_step, large_step).permute(back)
        total += _along(lines.flip(0), small_step, large_step).flip(0).permute(back)
    return total / 4


def _along(lines: Tensor, small_step: float, large_step: float) -> Tensor:
    """Least costs of paths over lines (L, D, X), from the first to each."""
    costs = torch.empty_like(lines)
    costs[0] = before = lines[0]
    for number in range(1, len(lines)):
        lowest = before.amin(dim=0, keepdim=True)
        best = torch.minimum(before, lowest + large_step)
        best[1:] = torch.minimum(best[1:], before[:-1] + small_step)
        best[:-1] = torch.minimum(best[:-1], before[1:] + small_step)
        before = torch.add(lines[number], best.sub_(lowest), out=costs[number])
    return costs


def between_planes(volume: Tensor, inverse: Tensor) -> Tensor:
    """Inverse depth of the least cost, between planes by a parabola; (D, h, w), (D,) -> (h, w)."""
    cheapest = volume.argmin(dim=0).clamp(1, len(inverse) - 2)
    before, at, after = (volume.gather(0, (cheapest + step)[None])[0] for step in (-1, 0, 1))
    offset = ((before - after) / (2 * (before - 2 * at + after)).clamp(min=1e-6)).clamp(-0.5, 0.5)
    return inverse[0] + (cheapest + offset) * (inverse[1] - inverse[0])
