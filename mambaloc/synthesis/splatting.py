"""Views of a scene at poses where nobody took a picture, from frames with depth.

The depth of the nearest frames is splatted into the new camera with a z-buffer, whose cracks are closed. Each pixel is
then looked up in the frames: the best-ranked one whose depth agrees within 3 % gives its colour, between pixels.
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

_SAME_SURFACE = 0.03  # of the depth
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
        self._depth_m = without_edges(torch.from_numpy(source.depth_m).to(self.device)).flatten(1)
        self._colors = torch.from_numpy(source.images).to(self.device).flatten(2).transpose(1, 2).reshape(-1, 3)
        self._pixel_from_world = source.intrinsics @ np.linalg.inv(source.world_from_cam)[:, :3]

    def nearest(self, world_from_cam: Floats, allowed: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """The frames that see most alike, the best first.

        Args:
            world_from_cam: (V, 4, 4).
            allowed: which frames may be taken, (V, S); all unless given.

        Returns:
            rows (V, N), of at most :data:`FRAMES`; -1 where no more may be taken.
        """
        apart = self.source.apart(world_from_cam)
        if allowed is not None:
            apart[~allowed] = np.inf
        rows = np.argsort(apart, axis=1, kind="stable")[:, :FRAMES]
        return np.where(np.isfinite(np.take_along_axis(apart, rows, axis=1)), rows, -1)

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
        is_past = (surface_m > (1 + _SAME_SURFACE) * z).any(axis=1)
        return is_past | ~(z > (1 + _SAME_SURFACE) * surface_m).any(axis=1)

    def render(
        self,
        world_from_cam: Floats,
        intrinsics: Floats,
        size: tuple[int, int],
        allowed: NDArray[np.bool_] | None = None,
    ) -> Rendered:
        """Render views.

        Args:
            world_from_cam: (V, 4, 4).
            intrinsics: of the views, (V, 3, 3), in pixels of ``size``.
            size: (height, width) of the views.
            allowed: which frames each may be made from, (V, S); all unless given.
        """
        rows = self.nearest(world_from_cam, allowed)
        frame = torch.from_numpy(rows).to(self.device)
        matrix, shift = between(self.source, rows, world_from_cam, intrinsics)
        nearest = closed(self._z_buffer(frame, self._tensor(matrix), self._tensor(shift), size))
        back = np.linalg.inv(matrix)
        back_shift = -np.einsum("vnij,vnj->vni", back, shift)
        colors, depth_m = self._look_up(frame, self._tensor(back), self._tensor(back_shift), nearest)
        is_known = ~depth_m.isnan()
        images = filled(torch.where(is_known[:, None], colors, 0), is_known[:, None].to(colors))
        return Rendered(images.clamp(0, 255).round().byte(), depth_m, 1 - is_known.float().mean(dim=(1, 2)))

    def _z_buffer(self, frame: Tensor, matrix: Tensor, shift: Tensor, size: tuple[int, int]) -> Tensor:
        """Depth (V, H, W) of the nearest point that falls on each pixel; infinite where none does."""
        views, (height, width) = len(frame), size
        depth_m = self._depth_m[frame].masked_fill_((frame < 0)[..., None], torch.nan)
        seen = carried(matrix, shift, self.source.depth_m.shape[1:], depth_m[:, :, None])
        z = seen[:, :, 2].contiguous()
        x, y = (seen[:, :, axis].div(z).round_() for axis in (0, 1))
        is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (z > _NEAR * self.scale_m)  # NaN is outside
        pixel = torch.where(is_inside, y.mul_(width).add_(x), height * width).long()
        pixel += torch.arange(views, device=self.device)[:, None, None] * (height * width + 1)
        nearest = z.new_full((views * (height * width + 1),), torch.inf)
        nearest.scatter_reduce_(0, pixel.flatten(), z.flatten(), "amin")
        return nearest.reshape(views, -1)[:, :-1].reshape(views, height, width)

    def _look_up(self, frame: Tensor, matrix: Tensor, shift: Tensor, nearest: Tensor) -> tuple[Tensor, Tensor]:
        """Colours (V, 3, H, W) and depth (V, H, W) in the first frame that sees each surface; NaN where none does."""
        views = len(frame)
        height, width = self.source.depth_m.shape[1:]
        size = nearest.shape[1:]
        seen = carried(matrix, shift, size, nearest.reshape(views, 1, 1, -1))
        z = seen[:, :, 2].contiguous()
        x, y = (seen[:, :, axis].div(z) for axis in (0, 1))
        is_inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5) & (z > 0)
        pixel = torch.where(is_inside, y.round().mul_(width).add_(x.round()), 0).long()
        pixel += frame.clamp(min=0)[..., None] * (height * width)
        ratio = self._depth_m.flatten()[pixel].div_(z)
        agrees = is_inside & ((ratio - 1).abs_() < _SAME_SURFACE) & (frame >= 0)[..., None]
        is_known, rank = agrees.byte().max(dim=1)  # the first of equals
        x, y, ratio = (values.gather(1, rank[:, None])[:, 0] for values in (x, y, ratio))
        is_known = is_known.bool()
        colors = self._colors_at(frame.gather(1, rank), x.where(is_known, 0), y.where(is_known, 0))
        depth_m = torch.where(is_known, nearest.flatten(1) * ratio, torch.nan)
        return colors.reshape(views, 3, *size), depth_m.reshape(views, *size)

    def _colors_at(self, frame: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Colours of frames at points; all (V, P) -> (V, 3, P)."""
        height, width = self.source.depth_m.shape[1:]
        x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
        left, top = x.long().clamp(max=width - 2), y.long().clamp(max=height - 2)
        right, below = (x - left)[..., None], (y - top)[..., None]
        corner = (frame.clamp(min=0) * height + top) * width + left

        def between(pixel: Tensor) -> Tensor:
            first, second = (self._colors[pixel + step].float() for step in (0, 1))
            return torch.lerp(first, second, right)

        return torch.lerp(between(corner), between(corner + width), below).transpose(1, 2)

    def _tensor(self, values: Floats) -> Tensor:
        return torch.from_numpy(values).to(self.device, torch.float32)


def between(
    source: PosedDepth, rows: NDArray[np.int64], world_from_cam: Floats, intrinsics: Floats
) -> tuple[Floats, Floats]:
    """What carries pixels times their depth from frames to views.

    Args:
        source: the frames.
        rows: of those that each view takes, (V, N).
        world_from_cam: of the views, (V, 4, 4).
        intrinsics: of the views, (V, 3, 3).

    Returns:
        matrices (V, N, 3, 3) and shifts (V, N, 3).
    """
    view_from_world = intrinsics @ np.linalg.inv(world_from_cam)[:, :3]
    view_from_cam = view_from_world[:, None, :, :3] @ source.world_from_cam[rows][..., :3, :]
    shift = view_from_cam[..., 3] + view_from_world[:, None, :, 3]
    return view_from_cam[..., :3] @ np.linalg.inv(source.intrinsics)[rows], shift


def carried(matrix: Tensor, shift: Tensor, size: tuple[int, ...], depth_m: Tensor) -> Tensor:
    """Pixels times their depth, in another camera: (V, N, 3, 3), (V, N, 3), (V, N or 1, 1, P) -> (V, N, 3, P)."""
    y, x = torch.meshgrid(*(torch.arange(length) for length in size), indexing="ij")
    pixels = torch.stack((x, y, torch.ones_like(x))).flatten(1).to(matrix)
    rays = (matrix.reshape(-1, 3) @ pixels).reshape(*matrix.shape[:3], -1)
    return rays.mul_(depth_m).add_(shift[..., None])


def without_edges(depth_m: Tensor) -> Tensor:
    """Depth (S, h, w) without pixels beside an edge, where it is of neither surface; NaN there."""
    farthest = F.max_pool2d(depth_m.nan_to_num(-torch.inf)[:, None], 3, 1, 1)[:, 0]
    nearest = -F.max_pool2d(-depth_m.nan_to_num(torch.inf)[:, None], 3, 1, 1)[:, 0]
    return depth_m.masked_fill(farthest - nearest > _EDGE * depth_m, torch.nan)


def closed(depth_m: Tensor) -> Tensor:
    """Close cracks of up to two pixels, through which a surface behind shows: (V, H, W), infinite where unknown."""
    inverse = 1 / depth_m[:, None]
    dilated = F.max_pool2d(inverse, 3, 1, 1)
    return 1 / -F.max_pool2d(-dilated, 3, 1, 1)[:, 0]


def filled(images: Tensor, known: Tensor) -> Tensor:
    """Fill holes from what surrounds them, from fine to coarse (pull-push, Gortler et al. 1996).

    Shape:
        ``images`` (V, 3, H, W), 0 in holes; ``known`` (V, 1, H, W), 1 or 0.
    """
    if min(images.shape[-2:]) == 1 or bool(known.all()):
        return images
    weight = F.avg_pool2d(known, 2, ceil_mode=True)
    coarse = F.avg_pool2d(images, 2, ceil_mode=True) / weight.clamp(min=1e-6)
    coarse = filled(coarse, (weight > 0).to(images))
    rough = F.interpolate(coarse, images.shape[-2:], mode="bilinear", align_corners=False)
    return torch.where(known > 0, images, rough)
