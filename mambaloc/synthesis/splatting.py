"""Views of a scene at poses where nobody took a picture, from frames with depth.

The depth of the nearest frames is splatted into the new camera with a z-buffer, whose cracks are closed. Each pixel is
then looked up in the frames: the best-ranked one whose depth agrees within 5 % gives its colour, between pixels.
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

_SAME_SURFACE = 0.05  # of the depth
_EDGE = 0.05  # of the depth, over three pixels
_NEAR = 0.02  # of the median depth
_FIRST = 4  # frames, in which a view's surfaces are looked up before the others


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
        self._depth_m = without_edges(torch.from_numpy(source.depth_m).to(self.device))
        self._colors = torch.from_numpy(source.images).to(self.device).flatten(2).transpose(1, 2).reshape(-1, 3)
        y, x = torch.meshgrid(
            *(torch.arange(length, device=self.device) for length in source.depth_m.shape[1:]), indexing="ij"
        )
        board = (x + y) % 2 == 0  # half of the pixels; cracks between them are closed
        self._board_m = self._depth_m[:, board]
        self._pixels = torch.stack((x[board], y[board], torch.ones_like(x[board])))[:, None].float()
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
        most_holes: float = 1.0,
    ) -> Rendered:
        """Render views.

        Args:
            world_from_cam: (V, 4, 4).
            intrinsics: of the views, (V, 3, 3), in pixels of ``size``.
            size: (height, width) of the views.
            allowed: which frames each may be made from, (V, S); all unless given.
            most_holes: a view with a larger share of holes is given up, wherever that shows, and is not filled.
        """
        frames = self.nearest(world_from_cam, allowed)
        matrix, shift = between(self.source, frames, world_from_cam, intrinsics)
        back = np.linalg.inv(matrix)
        back_shift = -np.einsum("vnij,vnj->vni", back, shift)
        views = []
        for row, rows in enumerate(frames):  # one by one: more would not fit a core's cache
            few = slice((rows >= 0).sum())
            there, cameras = (matrix[row, few], shift[row, few]), (back[row, few], back_shift[row, few])
            views.append(self._view(rows[few], there, cameras, size, most_holes))
        images, depth_m = (torch.stack(each) for each in zip(*views, strict=True))
        return Rendered(images, depth_m, depth_m.isnan().float().mean(dim=(1, 2)))

    def _view(
        self,
        rows: NDArray[np.int64],
        there: tuple[Floats, Floats],
        back: tuple[Floats, Floats],
        size: tuple[int, int],
        most_holes: float,
    ) -> tuple[Tensor, Tensor]:
        """Picture (3, H, W) and depth (H, W) of a view from N frames, by matrices and shifts to it and to these."""
        frame = torch.from_numpy(rows).to(self.device)
        nearest = closed(self._z_buffer(frame, self._tensor(there[0]), self._tensor(there[1]), size))
        image, depth_m = torch.zeros(3, *size, device=self.device), torch.full_like(nearest, torch.nan)
        if nearest.isinf().float().mean() <= most_holes:
            cameras = self._tensor(back[0]), self._tensor(back[1])
            self._look_up(frame, *cameras, nearest, image.flatten(1), depth_m.flatten())
            if depth_m.isnan().float().mean() <= most_holes:
                image = filled(image[None], depth_m.isfinite()[None, None].to(image))[0]
        return image.clamp_(0, 255).round_().byte(), depth_m

    def _z_buffer(self, frame: Tensor, matrix: Tensor, shift: Tensor, size: tuple[int, int]) -> Tensor:
        """Depth (H, W) of the nearest point of N frames on each pixel of a view; infinite where there is none."""
        height, width = size
        x, y, z = seen_from(matrix, shift, self._pixels * self._board_m[frame])
        x, y = x.div_(z).round_(), y.div_(z).round_()
        is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (z > _NEAR * self.scale_m)  # NaN is outside
        pixel = torch.where(is_inside, y.mul_(width).add_(x), height * width).long()
        nearest = z.new_full((height * width + 1,), torch.inf)
        nearest.scatter_reduce_(0, pixel.flatten(), z.flatten(), "amin")
        return nearest[:-1].reshape(size)

    def _look_up(
        self, frame: Tensor, matrix: Tensor, shift: Tensor, nearest: Tensor, image: Tensor, depth_m: Tensor
    ) -> None:
        """Fill in colours (3, H * W) and depth (H * W,) of each surface from the first frame that sees it.

        Args:
            frame: N of them, the best first.
            matrix: what carries the view's pixels times their depth to each, (N, 3, 3).
            shift: likewise, (N, 3).
            nearest: depth of each pixel, (H, W); infinite where there is none.
            image: changed in place.
            depth_m: likewise.
        """
        left = nearest.flatten().isfinite().nonzero()[:, 0]
        for few in (slice(_FIRST), slice(_FIRST, None)):  # most surfaces are seen by the first
            if not len(left) or not len(frame[few]):
                break
            z = nearest.flatten()[left]
            points = torch.stack(((left % nearest.shape[1]) * z, (left // nearest.shape[1]) * z, z))
            is_known, rank, x, y, ratio = self._first_that_sees(frame[few], matrix[few], shift[few], points)
            found = left[is_known]
            depth_m[found] = (z * ratio)[is_known]
            image[:, found] = self._colors_at(frame[few][rank[is_known]], x[is_known], y[is_known])
            left = left[~is_known]

    def _first_that_sees(
        self, frame: Tensor, matrix: Tensor, shift: Tensor, points: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Whether points (3, P) are seen by any of N frames, by which first, at which x and y, and how much farther."""
        height, width = self.source.depth_m.shape[1:]
        x, y, z = seen_from(matrix, shift, points[:, None])
        x, y = x.div_(z), y.div_(z)
        column, row = x.round(), y.round()
        is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 0)
        pixel = torch.where(is_inside, row.mul_(width).add_(column), 0).long()
        pixel += frame[:, None] * (height * width)
        ratio = self._depth_m.take(pixel).div_(z)
        agrees = is_inside & ((ratio - 1).abs_() < _SAME_SURFACE)
        is_known, rank = agrees.byte().max(dim=0)  # the first of equals
        x, y, ratio = (values.gather(0, rank[None])[0] for values in (x, y, ratio))
        return is_known.bool(), rank, x, y, ratio

    def _colors_at(self, frame: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Colours of frames at points; all (P,) -> (3, P)."""
        height, width = self.source.depth_m.shape[1:]
        x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
        left, top = x.long().clamp(max=width - 2), y.long().clamp(max=height - 2)
        right, below = (x - left)[:, None], (y - top)[:, None]
        corner = (frame * height + top) * width + left

        def between(pixel: Tensor) -> Tensor:
            return torch.lerp(self._colors[pixel].float(), self._colors[pixel + 1].float(), right)

        return torch.lerp(between(corner), between(corner + width), below).T

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


def seen_from(matrix: Tensor, shift: Tensor, points: Tensor) -> Tensor:
    """Pixels times their depth, in N other cameras: (N, 3, 3), (N, 3), (3, N or 1, P) -> (3, N, P)."""
    if points.shape[1] == 1:
        seen = (matrix.transpose(0, 1).reshape(-1, 3) @ points[:, 0]).reshape(3, len(matrix), -1)
    else:
        seen = torch.bmm(matrix, points.transpose(0, 1)).transpose(0, 1).contiguous()
    return seen.add_(shift.T[..., None])


def without_edges(depth_m: Tensor) -> Tensor:
    """Depth (S, h, w) without pixels beside an edge, where it is of neither surface; NaN there."""
    farthest, nearest = largest(depth_m.nan_to_num(-torch.inf)), -largest(-depth_m.nan_to_num(torch.inf))
    return depth_m.masked_fill(farthest - nearest > _EDGE * depth_m, torch.nan)


def closed(depth_m: Tensor) -> Tensor:
    """Close cracks of up to two pixels, through which a surface behind shows: (..., H, W), infinite where unknown."""
    return 1 / -largest(-largest(1 / depth_m))


def largest(values: Tensor) -> Tensor:
    """The largest of each pixel's 3x3 neighbourhood, (..., H, W); in steps, which are faster than pooling."""
    for axis in (-1, -2):
        before, after = values.narrow(axis, 0, values.shape[axis] - 1), values.narrow(axis, 1, values.shape[axis] - 1)
        values = values.clone()
        values.narrow(axis, 1, after.shape[axis]).copy_(torch.maximum(before, after))
        values.narrow(axis, 0, before.shape[axis]).copy_(
            torch.maximum(values.narrow(axis, 0, before.shape[axis]), after)
        )
    return values


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
