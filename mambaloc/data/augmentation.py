"""Crop and colour jitter of a whole batch, on whatever device it is on.

The paper's augmentation: random crop, brightness, contrast and saturation. Never a horizontal flip, which would show
a place that does not exist. Each image's colour jitter is one 3x4 matrix, so it costs one product.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mambaloc.geometry import cropped_intrinsics
from mambaloc.types import PoseBatch

_LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601, as torchvision and PIL


@dataclass(frozen=True)
class Jitter:
    """How far colours vary: each factor is drawn uniformly from ``[1 - x, 1 + x]``."""

    brightness: float = 0.3
    contrast: float = 0.3
    saturation: float = 0.3


@dataclass(frozen=True)
class Augmentations:
    """What happens to each image of a batch.

    Shape:
        ``top`` and ``left`` (B,), the crop's corner in pixels; ``color`` (B, 3, 4), an affine map of RGB in 0..1.
    """

    top: Tensor
    left: Tensor
    color: Tensor


def draw_uniforms(seed: int, epoch: int, frames: int) -> Tensor:
    """Draw an epoch's chances, uniform in [0, 1), (frames, 5): a frame's depend on (seed, epoch, its row) alone."""
    return torch.from_numpy(np.random.default_rng((seed, epoch)).random((frames, 5))).float()


def augmentations(image: Tensor, crop: tuple[int, int], jitter: Jitter, uniform: Tensor) -> Augmentations:
    """Say what happens to each image, without waiting for the device that it is on.

    Args:
        image: the batch, (B, 3, H, W) uint8.
        crop: height and width in pixels.
        jitter: the ranges of the colour factors.
        uniform: each image's row of :func:`draw_uniforms`, (B, 5), on the images' device.
    """
    height, width = image.shape[-2:]
    top, left = (
        (uniform[:, axis] * places).long().clamp_(max=places - 1)  # float32 may round up to the very end
        for axis, places in enumerate((height - crop[0] + 1, width - crop[1] + 1))
    )
    brightness, contrast, saturation = (
        1 - spread + 2 * spread * uniform[:, axis]
        for axis, spread in enumerate((jitter.brightness, jitter.contrast, jitter.saturation), start=2)
    )
    means = image[..., ::4, ::4].float().mean((-2, -1)) / 255
    luma_mean = sum((weight * mean for weight, mean in zip(_LUMA, means.unbind(-1), strict=True)), torch.zeros(()))
    return Augmentations(top, left, color_matrices(brightness, contrast, saturation, luma_mean))


def color_matrices(brightness: Tensor, contrast: Tensor, saturation: Tensor, luma_mean: Tensor) -> Tensor:
    """Compose each image's three adjustments, in this order, into one affine map of RGB; (B,) each -> (B, 3, 4).

    Args:
        brightness: factor on all channels.
        contrast: blend with the image's mean luma.
        saturation: blend with each pixel's luma.
        luma_mean: mean luma of the image before the adjustments, in 0..1.
    """
    # No constant tensors: making one on a GPU waits for it.
    luma_B3 = torch.stack([(1 - saturation) * weight for weight in _LUMA], dim=-1)
    saturate_B33 = torch.diag_embed(saturation[:, None].expand(-1, 3)) + luma_B3[:, None]
    gain, offset = contrast * brightness, (1 - contrast) * brightness * luma_mean  # saturation leaves gray as it is
    return torch.cat((saturate_B33 * gain[:, None, None], offset[:, None, None].expand(-1, 3, 1)), dim=-1)


def augment(image: Tensor, how: Augmentations, crop: tuple[int, int]) -> Tensor:
    """Crop and colour a batch; (B, 3, H, W) uint8 -> (B, 3, *crop) float32 in 0..1."""
    pixels = _crops(image, how.top, how.left, crop).flatten(2).float()
    return torch.baddbmm(how.color[..., 3:], how.color[..., :3] / 255, pixels).clamp_(0, 1).unflatten(-1, crop)


def _crops(image: Tensor, top: Tensor, left: Tensor, crop: tuple[int, int]) -> Tensor:
    if image.device.type == "cpu":  # copying row by row takes a tenth of the time of the gather below
        corners = zip(top.tolist(), left.tolist(), strict=True)
        return torch.stack([i[:, y : y + crop[0], x : x + crop[1]] for i, (y, x) in zip(image, corners, strict=True)])
    windows = image.unfold(2, crop[0], 1).unfold(3, crop[1], 1)  # (B, 3, tops, lefts, *crop), a view
    return windows[torch.arange(len(image), device=image.device), :, top, left]


def center_crop(image: Tensor, crop: tuple[int, int]) -> Tensor:
    """Take the middle of a batch; (B, 3, H, W) uint8 -> (B, 3, *crop) float32 in 0..1."""
    top, left = center_corner(image, crop)
    return image[..., top : top + crop[0], left : left + crop[1]].float() / 255


def center_corner(image: Tensor, crop: tuple[int, int]) -> tuple[int, int]:
    """Row and column of the top-left pixel of a batch's centre crop; (B, 3, H, W) -> two numbers."""
    return (image.shape[-2] - crop[0]) // 2, (image.shape[-1] - crop[1]) // 2


def centered(batch: PoseBatch, crop: tuple[int, int]) -> PoseBatch:
    """Take the middle of a batch's images, as :func:`center_crop`; intrinsics follow."""
    corner = center_corner(batch.image, crop)
    intrinsics = None if batch.intrinsics is None else cropped_intrinsics(batch.intrinsics, *corner)
    return replace(batch, image=center_crop(batch.image, crop), intrinsics=intrinsics)
