"""Crop and colour jitter of a whole batch, on whatever device it is on.

The paper's augmentation: random crop, brightness, contrast and saturation. Never a horizontal flip, which would show
a place that does not exist. Each image's colour jitter is one 3x4 matrix, so it costs one product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601, as torchvision and PIL


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


def draw_augmentations(
    image: Tensor, crop: tuple[int, int], jitter: Jitter, seed: int, epoch: int, index: Tensor
) -> Augmentations:
    """Draw each image's crop and colours from (seed, epoch, its index) alone, so a resumed run draws the same.

    Args:
        image: the batch, (B, 3, H, W) uint8.
        crop: height and width in pixels.
        jitter: the ranges of the colour factors.
        seed: the run's seed.
        epoch: the epoch's number.
        index: each image's row in its split, (B,).
    """
    height, width = image.shape[-2:]
    corners = np.empty((len(image), 2), dtype=np.int64)
    colors = np.empty((len(image), 3, 4), dtype=np.float32)
    luma_means = (image[..., ::4, ::4].float().mean((-2, -1)).cpu().numpy() / 255) @ _LUMA
    for row, frame in enumerate(index.tolist()):
        rng = np.random.default_rng((seed, epoch, frame))
        corners[row] = rng.integers(0, (height - crop[0] + 1, width - crop[1] + 1))
        spread = np.array([jitter.brightness, jitter.contrast, jitter.saturation])
        brightness, contrast, saturation = rng.uniform(1 - spread, 1 + spread)
        colors[row] = color_matrix(brightness, contrast, saturation, luma_means[row])
    return Augmentations(torch.from_numpy(corners[:, 0]), torch.from_numpy(corners[:, 1]), torch.from_numpy(colors))


def color_matrix(brightness: float, contrast: float, saturation: float, luma_mean: float) -> NDArray[np.float64]:
    """Compose the three adjustments, in this order, into one affine map of RGB; (3, 4).

    Args:
        brightness: factor on all channels.
        contrast: blend with the image's mean luma.
        saturation: blend with each pixel's luma.
        luma_mean: mean luma of the image before the adjustments, in 0..1.
    """
    saturate = saturation * np.eye(3) + (1 - saturation) * np.tile(_LUMA, (3, 1))
    offset = saturate @ np.full(3, (1 - contrast) * brightness * luma_mean)
    return np.column_stack((saturate * (contrast * brightness), offset))


def augment(image: Tensor, how: Augmentations, crop: tuple[int, int]) -> Tensor:
    """Crop and colour a batch; (B, 3, H, W) uint8 -> (B, 3, *crop) float32 in 0..1."""
    corners = zip(how.top.tolist(), how.left.tolist(), strict=True)
    crops = [i[:, top : top + crop[0], left : left + crop[1]] for i, (top, left) in zip(image, corners, strict=True)]
    pixels = torch.stack(crops).flatten(2).float()
    color = how.color.to(pixels)
    return torch.baddbmm(color[..., 3:], color[..., :3] / 255, pixels).clamp_(0, 1).unflatten(-1, crop)


def center_crop(image: Tensor, crop: tuple[int, int]) -> Tensor:
    """Take the middle of a batch; (B, 3, H, W) uint8 -> (B, 3, *crop) float32 in 0..1."""
    top, left = center_corner(image, crop)
    return image[..., top : top + crop[0], left : left + crop[1]].float() / 255


def center_corner(image: Tensor, crop: tuple[int, int]) -> tuple[int, int]:
    """Row and column of the top-left pixel of a batch's centre crop; (B, 3, H, W) -> two numbers."""
    return (image.shape[-2] - crop[0]) // 2, (image.shape[-1] - crop[1]) // 2
