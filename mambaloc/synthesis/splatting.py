"""Views of a scene at poses without a real image, from frames with depth.

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

from mambaloc.renamed import renamed_arguments
from mambaloc.synthesis.posed_depth import Floats, PosedDepth

FRAMES = 12
"""How many frames a view is made from."""

_SAME_SURFACE = 0.05  # of the depth
_EDGE = 0.05  # of the depth, over three pixels
_NEAR = 0.02  # of the median depth
_FIRST = 4  # frames, in which a view's surfaces are looked up before the others
_NOWHERE = 1e30  # depth that no frame has
_AT_ONCE = 4  # views; more would not fit a core's cache


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
        depth_m = without_edges(torch.from_numpy(source.depth_m).to(self.device))
        self._padded_m = F.pad(depth_m, (1, 1, 1, 1), value=torch.nan).flatten()
        self._colors = torch.from_numpy(source.images).to(self.device).flatten()
        self._center_m = source.world_from_cam[:, :3, 3].mean(axis=0)  # far from the origin, float32 is coarse
        self._points_m = [self._lifted(row, depth_m[row]) for row in range(len(source))]
        self._pixel_from_world = source.intrinsics @ np.linalg.inv(source.world_from_cam)[:, :3]

    def _lifted(self, row: int, depth_m: Tensor) -> Tensor:
        """Points (3, P) of half of a frame's pixels, like a chessboard's, from the centre; cracks are closed later."""
        y, x = depth_m.isfinite().nonzero().T
        is_black = (x + y) % 2 == 0
        y, x = y[is_black], x[is_black]
        pose, matrix = self.source.world_from_cam[row], np.linalg.inv(self.source.intrinsics[row])
        rays = torch.stack((x, y, torch.ones_like(x))) * depth_m[y, x]
        world_from_pixel, position_m = pose[:3, :3] @ matrix, pose[:3, 3] - self._center_m
        return torch.addmm(self._tensor(position_m)[:, None], self._tensor(world_from_pixel), rays)

    def nearest(self, world_from_cam: Floats, allowed: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """The frames that see most alike, the best first.

        Args:
            world_from_cam: (V, 4, 4).
            allowed: which frames may be taken, (V, S); all unless given.

        Returns:
            rows (V, N), of at most :data:`FRAMES`; -1 where no more may be taken.
        """
        distance = self.source.distance(world_from_cam)
        if allowed is not None:
            distance[~allowed] = np.inf
        rows = np.argsort(distance, axis=1, kind="stable")[:, :FRAMES]
        return np.where(np.isfinite(np.take_along_axis(distance, rows, axis=1)), rows, -1)

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

    @renamed_arguments(most_holes="max_holes")
    def render(
        self,
        world_from_cam: Floats,
        intrinsics: Floats,
        size: tuple[int, int],
        allowed: NDArray[np.bool_] | None = None,
        max_holes: float = 1.0,
    ) -> Rendered:
        """Render views.

        Args:
            world_from_cam: (V, 4, 4).
            intrinsics: of the views, (V, 3, 3), in pixels of ``size``.
            size: (height, width) of the views.
            allowed: which frames each may be made from, (V, S); all unless given.
            max_holes: a view with a larger share of holes is given up, wherever that shows, and is not filled.
        """
        frames = self.nearest(world_from_cam, allowed)
        matrix, shift = between(self.source, frames, world_from_cam, intrinsics)
        back = np.linalg.inv(matrix)
        to_frames = self._tensor(np.concatenate((back, -back @ shift[..., None]), axis=-1))
        view_from_world = intrinsics @ np.linalg.inv(world_from_cam)[:, :3]
        view_from_world[..., 3] += view_from_world[..., :3] @ self._center_m
        to_view, pixels = self._tensor(view_from_world), self._pixels(size)
        views = []
        for start in range(0, len(frames), _AT_ONCE):
            some = slice(start, start + _AT_ONCE)
            each = [rows[rows >= 0] for rows in frames[some]]
            views.append(self._views(each, to_view[some], to_frames[some], pixels, max_holes))
        images, depth_m = (torch.cat(each) for each in zip(*views, strict=True))
        return Rendered(images, depth_m, depth_m.isnan().float().mean(dim=(1, 2)))

    def _views(
        self, frames: list[NDArray[np.int64]], to_view: Tensor, to_frames: Tensor, pixels: Tensor, max_holes: float
    ) -> tuple[Tensor, Tensor]:
        """Images (V, 3, H, W) and depth (V, H, W) of views.

        Args:
            frames: rows of those that each is made from, at most N, the best first.
            to_view: what carries world points to its pixels times their depth, (V, 3, 4).
            to_frames: what carries its pixels times their depth to its frames' times theirs, (V, N, 3, 4).
            pixels: (3, H, W), homogeneous.
            max_holes: see :meth:`render`.
        """
        size = pixels.shape[1:]
        nearest = closed(torch.stack([self._z_buffer(*each, size) for each in zip(frames, to_view, strict=True)]))
        images, depth_m = nearest.new_zeros(len(frames), 3, *size), torch.full_like(nearest, torch.nan)
        shares = nearest.isinf().float().mean(dim=(1, 2))
        for view in ((shares <= max_holes) & (shares < 1)).nonzero()[:, 0].tolist():
            images[view], depth_m[view] = self._look_up(frames[view], to_frames[view], nearest[view], pixels)
        is_kept = depth_m.isnan().float().mean(dim=(1, 2)) <= max_holes
        images[is_kept] = filled(images[is_kept], depth_m[is_kept, None].isfinite().to(images))
        return images.clamp_(0, 255).round_().byte(), depth_m

    def _z_buffer(self, frames: NDArray[np.int64], to_view: Tensor, size: torch.Size) -> Tensor:
        """Depth (H, W) of the nearest point of some frames on each pixel of a view; infinite without a point."""
        height, width = size
        buffer = to_view.new_full(((height + 2) * (width + 2),), torch.inf)  # a border takes what lies outside
        if len(frames):
            points_m = torch.cat([self._points_m[row] for row in frames], dim=1)
            x, y, z = torch.addmm(to_view[:, 3:], to_view[:, :3], points_m)
            torch.threshold_(z, _NEAR * self.scale_m, torch.inf)
            x.div_(z).round_().clamp_(-1, width)
            y.div_(z).round_().clamp_(-1, height)
            buffer.scatter_reduce_(0, y.mul_(width + 2).add_(x).add_(width + 3).long(), z, "amin")
        return buffer.view(height + 2, width + 2)[1:-1, 1:-1]

    def _look_up(
        self, frames: NDArray[np.int64], to_frames: Tensor, nearest: Tensor, pixels: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Colours (3, H, W) and depth (H, W) of a view's surfaces as the first of N frames that sees each does.

        Colours are 0 and depth is NaN where none does; the arguments are those of :meth:`_views`, of one view.
        """
        frame = torch.from_numpy(frames).to(self.device)
        z = nearest.flatten().clamp(max=_NOWHERE)
        points = pixels.flatten(1) * z
        seen = self._first_that_sees(frame[:_FIRST], to_frames[:_FIRST], points)  # most surfaces
        if len(frame) > _FIRST:
            left = (seen[3].isnan() & nearest.flatten().isfinite()).nonzero()[:, 0]
            others = self._first_that_sees(frame[_FIRST:], to_frames[_FIRST:], points.index_select(1, left))
            seen.index_copy_(1, left, others)
        image = self._colors_at(*seen[:3])
        image *= seen[3].isfinite()
        return image.view(3, *nearest.shape), z.mul_(seen[3]).view_as(nearest)

    def _first_that_sees(self, frame: Tensor, to_frames: Tensor, points: Tensor) -> Tensor:
        """Which of N frames sees points (3, P) first, at which x and y, and how much farther, NaN where none does.

        The four are the rows of (4, P); ``to_frames`` is (N or more, 3, 4).
        """
        (height, width), (count, size) = self.source.depth_m.shape[1:], (len(frame), points.shape[1])
        rotated = (to_frames[:count, :, :3].transpose(0, 1).reshape(-1, 3) @ points).view(3, count, size)
        x, y, z = rotated.add_(to_frames[:count, :, 3].T[..., None])
        torch.threshold_(z, 0, torch.inf)
        x, y = x.div_(z), y.div_(z)
        pixel = y.round().clamp_(-1, height).mul_(width + 2).add_(x.round().clamp_(-1, width)).int()
        pixel += ((frame * (height + 2) + 1) * (width + 2) + 1).int()[:, None]
        ratio = torch.div(self._padded_m.index_select(0, pixel.flatten()).view_as(z), z, out=z)
        agrees = (ratio - 1).abs_() < _SAME_SURFACE
        order = torch.arange(count, 0, -1, dtype=torch.uint8, device=self.device)[:, None]
        best = (agrees * order).amax(dim=0)  # the first has the highest
        rank = count - best.clamp(min=1).int()
        chosen = rank * size + torch.arange(size, dtype=torch.int32, device=self.device)
        x, y, ratio = (each.flatten().index_select(0, chosen) for each in (x, y, ratio))
        return torch.stack((frame.index_select(0, rank).float(), x, y, torch.where(best > 0, ratio, torch.nan)))

    def _colors_at(self, frame: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Colours of frames between pixels; all (P,) -> (3, P)."""
        height, width = self.source.depth_m.shape[1:]
        x, y = x.clamp_(0, width - 1), y.clamp_(0, height - 1)
        left, top = x.int().clamp_(max=width - 2), y.int().clamp_(max=height - 2)
        corner = (frame.int() * (3 * height) + top) * width + left
        beside = torch.tensor([0, 1, width, width + 1], dtype=torch.int32, device=self.device)[:, None]
        channel = torch.arange(3, dtype=torch.int32, device=self.device)[:, None, None] * (height * width)
        corners = self._colors.index_select(0, (corner + beside + channel).flatten()).float().view(3, 2, 2, -1)
        row = torch.lerp(corners[:, :, 0], corners[:, :, 1], x - left)
        return torch.lerp(row[:, 0], row[:, 1], y - top)

    def _pixels(self, size: tuple[int, int]) -> Tensor:
        """Homogeneous pixels (3, H, W)."""
        y, x = torch.meshgrid(*(torch.arange(length, device=self.device) for length in size), indexing="ij")
        return torch.stack((x, y, torch.ones_like(x))).float()

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
