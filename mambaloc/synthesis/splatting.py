"""Views of a scene at poses where nobody took a picture, from frames with depth.

The depth of the nearest frames is splatted into the new camera with a z-buffer. Each pixel takes its depth from the
best-ranked frame within 3 % of the nearest surface, and its colour from where that frame sees it, between pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mambaloc.synthesis.posed_depth import Floats, PosedDepth

FRAMES = 12
"""How many frames a view is made from."""

_SAME_SURFACE = 1.03  # of the nearest depth
_EDGE = 0.05  # of the depth, over three pixels
_NEAR = 0.02  # of the median depth


@dataclass(frozen=True)
class Rendered:
    """Views as new cameras see them.

    Shape:
        ``images`` (V, 3, H, W) uint8, holes filled; ``depth_m`` (V, H, W), NaN in holes; ``hole_share`` (V,).
    """

    images: Tensor
    depth_m: Tensor
    hole_share: Tensor


class Splatter:
    """Renders views from frames with depth, on any device.

    Args:
        source: S frames.
        device: that renders.
    """

    def __init__(self, source: PosedDepth, device: torch.device | str = "cpu") -> None:
        self.source, self.device = source, torch.device(device)
        self.scale_m = source.median_depth_m
        depth_m = torch.from_numpy(source.depth_m).to(self.device)
        self._depth_m = without_edges(depth_m).flatten(1)
        self._colors = torch.from_numpy(source.images).to(self.device).flatten(2).transpose(1, 2).reshape(-1, 3)
        self._rays = _pixels(*source.depth_m.shape[1:], self.device)
        self._pixel_from_world = source.intrinsics @ np.linalg.inv(source.world_from_cam)[:, :3]
        self._forward = source.world_from_cam[:, :3, 2]

    def nearest(self, world_from_cam: Floats, allowed: Floats | None = None) -> Floats:
        """The frames that see most alike, best first: near in position, in median depths, and in direction, in radians.

        Args:
            world_from_cam: (V, 4, 4).
            allowed: which frames may be taken, (V, S) or (S,) bool; all unless given.

        Returns:
            rows (V, N), of at most :data:`FRAMES`.
        """
        offset = np.linalg.norm(world_from_cam[:, None, :3, 3] - self.source.world_from_cam[:, :3, 3], axis=-1)
        angle = np.arccos(np.clip(world_from_cam[:, :3, 2] @ self._forward.T, -1, 1))
        apart = np.hypot(offset / self.scale_m, angle)
        if allowed is not None:
            apart = np.where(allowed, apart, np.inf)
        return np.argsort(apart, axis=1, kind="stable")[:, :FRAMES]

    def render(
        self, world_from_cam: Floats, intrinsics: Floats, size: tuple[int, int], allowed: Floats | None = None
    ) -> Rendered:
        """Render views.

        Args:
            world_from_cam: (V, 4, 4).
            intrinsics: of the views, (V, 3, 3), in pixels of ``size``.
            size: (height, width) of the views.
            allowed: which frames may be taken, (V, S) or (S,) bool; all unless given.
        """
        rows = self.nearest(world_from_cam, allowed)
        views, frames = rows.shape
        height, width = size
        view_from_frame, shift = self._between(rows, world_from_cam, intrinsics)
        usable = torch.from_numpy(rows).to(self.device)

        # depth * (M @ pixel) + shift: what pixels of the frames are in the view, times their depth there
        depth_m = self._depth_m[usable]
        if allowed is not None:
            is_allowed = np.take_along_axis(np.broadcast_to(allowed, (views, len(self.source))), rows, axis=1)
            depth_m = depth_m.masked_fill(~torch.from_numpy(is_allowed).to(self.device)[..., None], torch.nan)
        seen = (self._tensor(view_from_frame).reshape(-1, 3) @ self._rays).reshape(views, frames, 3, -1)
        seen.mul_(depth_m[:, :, None]).add_(self._tensor(shift)[..., None])
        z = seen[:, :, 2].contiguous()
        x, y = (seen[:, :, axis].div(z).round_() for axis in (0, 1))
        is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (z > _NEAR * self.scale_m)  # NaN is outside
        target = torch.where(is_inside, y.mul_(width).add_(x), height * width).long().flatten(1)

        winner, z_won = _nearest_surface(target, z.flatten(1), height * width)
        is_hole = winner < 0
        rank = winner.clamp(min=0) // self._rays.shape[1]
        colors = self._look_up(usable, rank, z_won, view_from_frame, shift, size)
        images = torch.where(is_hole[:, None], 0, colors).reshape(views, 3, height, width)
        known = (~is_hole).to(images).reshape(views, 1, height, width)
        filled = _filled(images, known).clamp(0, 255).round().byte()
        depth = torch.where(is_hole, torch.nan, z_won)
        return Rendered(filled, depth.reshape(views, height, width), is_hole.float().mean(dim=1))

    def is_free(self, position_m: Floats) -> NDArray[np.bool_]:
        """Whether cameras may stand at points (V, 3): some frame sees past them, or none sees a surface before them."""
        seen = np.einsum("sij,vj->vsi", self._pixel_from_world[..., :3], position_m) + self._pixel_from_world[..., 3]
        height, width = self.source.depth_m.shape[1:]
        z = seen[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = np.rint(seen[..., 0] / z), np.rint(seen[..., 1] / z)
            is_seen = (z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        x, y = (np.where(is_seen, axis, 0).astype(int) for axis in (x, y))
        surface_m = np.where(is_seen, self.source.depth_m[np.arange(len(self.source)), y, x], np.nan)
        is_past = (surface_m > _SAME_SURFACE * z).any(axis=1)
        return is_past | ~(z > _SAME_SURFACE * surface_m).any(axis=1)

    def _between(self, rows: Floats, world_from_cam: Floats, intrinsics: Floats) -> tuple[Floats, Floats]:
        """Matrices (V, N, 3, 3) and shifts (V, N, 3) from pixels of frames to pixels of views."""
        view_from_world = intrinsics @ np.linalg.inv(world_from_cam)[:, :3]
        frame_from_cam = np.linalg.inv(self.source.intrinsics)[rows]
        world_from_frame = self.source.world_from_cam[rows]
        view_from_cam = view_from_world[:, None, :, :3] @ world_from_frame[..., :3, :]
        shift = view_from_cam[..., 3] + view_from_world[:, None, :, 3]
        return view_from_cam[..., :3] @ frame_from_cam, shift

    def _look_up(
        self, rows: Tensor, rank: Tensor, z: Tensor, view_from_frame: Floats, shift: Floats, size: tuple[int, int]
    ) -> Tensor:
        """Colours (V, 3, P) of the surface in each pixel, between the pixels of the frame that won it."""
        views, frames = rows.shape
        frame_from_view = np.linalg.inv(view_from_frame)
        back = self._tensor(np.einsum("vnij,vnj->vni", frame_from_view, shift))
        at = (self._tensor(frame_from_view).reshape(-1, 3) @ _pixels(*size, self.device)).reshape(views, frames, 3, -1)
        of_rank = rank[:, None].expand(-1, 3, -1)
        at = at.gather(1, of_rank[:, None])[:, 0] * z[:, None] - back.transpose(1, 2).gather(2, of_rank)
        height, width = self.source.depth_m.shape[1:]
        x = (at[:, 0] / at[:, 2]).nan_to_num(0).clamp(0, width - 1)
        y = (at[:, 1] / at[:, 2]).nan_to_num(0).clamp(0, height - 1)
        left, top = x.long().clamp(max=width - 2), y.long().clamp(max=height - 2)
        x, y = (x - left)[..., None], (y - top)[..., None]
        corner = (rows.gather(1, rank) * height + top) * width + left

        def row_of(corner: Tensor) -> Tensor:
            first, second = (self._colors[corner + step].float() for step in (0, 1))
            return torch.lerp(first, second, x)

        return torch.lerp(row_of(corner), row_of(corner + width), y).transpose(1, 2)

    def _tensor(self, values: Floats) -> Tensor:
        return torch.from_numpy(values).to(self.device, torch.float32)


def without_edges(depth_m: Tensor) -> Tensor:
    """Depth (S, h, w) without pixels beside an edge, where it is of neither surface; NaN there."""
    farthest = F.max_pool2d(depth_m.nan_to_num(-torch.inf)[:, None], 3, 1, 1)[:, 0]
    nearest = -F.max_pool2d(-depth_m.nan_to_num(torch.inf)[:, None], 3, 1, 1)[:, 0]
    return depth_m.masked_fill(farthest - nearest > _EDGE * depth_m, torch.nan)


def _pixels(height: int, width: int, device: torch.device) -> Tensor:
    """Homogeneous pixels, (3, height * width)."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack((x, y, torch.ones_like(x))).flatten(1).to(device, torch.float32)


def _nearest_surface(target: Tensor, z: Tensor, pixels: int) -> tuple[Tensor, Tensor]:
    """The first point within 3 % of the nearest in each pixel, and its depth.

    Shape:
        ``target`` (V, M): the pixel that each point falls on, ``pixels`` where on none; ``z`` (V, M) ->
        (V, pixels) row of the point, -1 where there is none; (V, pixels).
    """
    views, points = z.shape
    target = target + (pixels + 1) * torch.arange(views, device=z.device)[:, None]
    nearest = z.new_full((views * (pixels + 1),), torch.inf)
    nearest.scatter_reduce_(0, target.flatten(), z.flatten(), "amin")
    row = torch.arange(points, dtype=torch.int32, device=z.device).expand(views, -1)
    row = torch.where(z <= _SAME_SURFACE * nearest[target], row, points)
    winner = torch.full_like(nearest, points, dtype=torch.int32)
    winner.scatter_reduce_(0, target.flatten(), row.flatten(), "amin")
    winner = winner.reshape(views, -1)[:, :pixels].long()
    z_won = z.gather(1, winner.clamp(max=points - 1))
    return torch.where(winner == points, -1, winner), z_won


def _filled(images: Tensor, known: Tensor) -> Tensor:
    """Fill holes from what surrounds them, from fine to coarse (pull-push, Gortler et al. 1996).

    Shape:
        ``images`` (V, 3, H, W), 0 in holes; ``known`` (V, 1, H, W), 1 or 0.
    """
    if min(images.shape[-2:]) == 1 or bool(known.all()):
        return images
    weight = F.avg_pool2d(known, 2, ceil_mode=True)
    coarse = F.avg_pool2d(images, 2, ceil_mode=True) / weight.clamp(min=1e-6)
    coarse = _filled(coarse, (weight > 0).to(images))
    rough = F.interpolate(coarse, images.shape[-2:], mode="bilinear", align_corners=False)
    return torch.where(known > 0, images, rough)
