"""Another view and other colours for each image of a training batch, on whatever device it is on.

A view is a crop, as in the paper, or what a camera turned about its centre sees; never a mirror image, which would show
a place that does not exist. Colours vary in brightness, contrast and saturation: one 3x4 matrix an image, one product.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from mambaloc.errors import InputError
from mambaloc.geometry import (
    canonical,
    cropped_intrinsics,
    matrix_from_quaternion,
    multiply,
    quaternion_from_log,
    rotation_homography,
    warped,
)
from mambaloc.images import LUMA, center_corner
from mambaloc.types import PoseBatch

_MAX_DEG = 45.0
_DONORS = 3  # images that a hole may be filled from

View = Literal["crop", "rotation"]


@dataclass(frozen=True)
class Jitter:
    """How far colours vary: each factor is drawn uniformly from ``[1 - x, 1 + x]``."""

    draws: ClassVar[int] = 3

    brightness: float = 0.3
    contrast: float = 0.3
    saturation: float = 0.3

    def matrices(self, image: Tensor, uniform: Tensor) -> Tensor:
        """Each image's affine map of RGB in 0..1; (B, 3, H, W) uint8, (B, 3) in [0, 1) -> (B, 3, 4)."""
        brightness, contrast, saturation = (
            1 - spread + 2 * spread * drawn
            for spread, drawn in zip(
                (self.brightness, self.contrast, self.saturation), uniform.unbind(dim=1), strict=True
            )
        )
        means = image[..., ::4, ::4].float().mean((-2, -1)) / 255
        luma_mean = sum((weight * mean for weight, mean in zip(LUMA, means.unbind(-1), strict=True)), torch.zeros(()))
        return color_matrices(brightness, contrast, saturation, luma_mean)


@dataclass(frozen=True)
class RandomCrop:
    """A crop anywhere in the frame: the paper's augmentation.

    The pose stays the frame's, so that crops which look up to some degrees apart are asked for one rotation; their
    intrinsics say where each lies.

    Args:
        size: height and width in pixels.
    """

    draws: ClassVar[int] = 2

    size: tuple[int, int]

    def corners(self, image: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """Row and column of each crop's top-left pixel; (B, 3, H, W), (B, 2) in [0, 1) -> (B,) each."""
        places = (image.shape[-2] - self.size[0] + 1, image.shape[-1] - self.size[1] + 1)
        top, left = (
            (uniform[:, axis] * count).long().clamp_(max=count - 1)  # float32 may round up to the very end
            for axis, count in enumerate(places)
        )
        return top, left

    def __call__(self, batch: PoseBatch, color: Tensor, uniform: Tensor) -> PoseBatch:
        """Crop and colour a batch; ``image`` (B, 3, H, W) uint8 becomes (B, 3, *size) float32 in 0..1."""
        top, left = self.corners(batch.image, uniform)
        image, holes = colored(_crops(batch.image, top, left, self.size), color), None
        if batch.holes is not None:
            holes = _crops(batch.holes[:, None], top, left, self.size)[:, 0]
            image = filled_from_each_other(image, holes)
        return replace(batch, image=image, intrinsics=_cropped(batch, top, left), holes=holes)


@dataclass(frozen=True)
class RandomRotation:
    """What a camera turned about its centre, and perhaps zoomed, sees of the frame: exact, black beyond its border.

    The true pose is the turned camera's, and intrinsics are its own, so that nothing is asked for that the image does
    not show. Frames of a clip turn each on its own: poses of a clip relative to each other stay true.

    Args:
        size: height and width in pixels.
        rotation_deg: each component of the rotation vector is uniform within this much of 0: pitch, yaw and roll.
        zoom: focal lengths are scaled by a factor, log-uniform from ``1 / (1 + zoom)`` to ``1 + zoom``.

    Raises:
        InputError: for a number that is out of range.
    """

    draws: ClassVar[int] = 4

    size: tuple[int, int]
    rotation_deg: float = 10.0
    zoom: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.rotation_deg <= _MAX_DEG:
            raise InputError(f"data.rotation_deg {self.rotation_deg:g}: must be more than 0, and {_MAX_DEG:g} at most")
        if not 0 <= self.zoom < math.inf:
            raise InputError(f"data.zoom {self.zoom:g}: must be 0 or more; 0 leaves focal lengths as they are")

    def __call__(self, batch: PoseBatch, color: Tensor, uniform: Tensor) -> PoseBatch:
        """Colour and turn a batch; ``image`` (B, 3, H, W) uint8 becomes (B, 3, *size) float32 in 0..1."""
        assert batch.intrinsics is not None  # the data module always gives them
        spread = 2 * uniform - 1
        # A log-quaternion is half a rotation vector.
        cam_from_turned = quaternion_from_log(spread[:, :3] * (math.radians(self.rotation_deg) / 2))
        intrinsics = cropped_intrinsics(batch.intrinsics, *center_corner(batch.image.shape[-2:], self.size))
        scale = torch.exp(spread[:, 3] * math.log1p(self.zoom))
        intrinsics[:, :2, :2] *= scale[:, None, None]
        homography = rotation_homography(batch.intrinsics, matrix_from_quaternion(cam_from_turned), intrinsics)
        image, holes = warped(colored(batch.image, color), homography, self.size), None
        if batch.holes is not None:
            holes = warped(batch.holes[:, None].to(image), homography, self.size)[:, 0] > 0.5
            image = filled_from_each_other(image, holes)
        quaternion = canonical(multiply(batch.quaternion, cam_from_turned))
        return replace(batch, image=image, quaternion=quaternion, intrinsics=intrinsics, holes=holes)


def draw_uniforms(seed: int, epoch: int, frames: int, draws: int) -> Tensor:
    """Draw an epoch's chances, uniform in [0, 1), (frames, draws): a frame's depend on (seed, epoch, its row) alone."""
    return torch.from_numpy(np.random.default_rng((seed, epoch)).random((frames, draws))).float()


def color_matrices(brightness: Tensor, contrast: Tensor, saturation: Tensor, luma_mean: Tensor) -> Tensor:
    """Compose each image's three adjustments, in this order, into one affine map of RGB; (B,) each -> (B, 3, 4).

    Args:
        brightness: factor on all channels.
        contrast: blend with the image's mean luma.
        saturation: blend with each pixel's luma.
        luma_mean: mean luma of the image before the adjustments, in 0..1.
    """
    # No constant tensors: making one on a GPU waits for it.
    luma_B3 = torch.stack([(1 - saturation) * weight for weight in LUMA], dim=-1)
    saturate_B33 = torch.diag_embed(saturation[:, None].expand(-1, 3)) + luma_B3[:, None]
    gain, offset = contrast * brightness, (1 - contrast) * brightness * luma_mean  # saturation leaves gray as it is
    return torch.cat((saturate_B33 * gain[:, None, None], offset[:, None, None].expand(-1, 3, 1)), dim=-1)


def colored(image: Tensor, color: Tensor) -> Tensor:
    """Map the colours of a batch; (B, 3, H, W) uint8, (B, 3, 4) -> (B, 3, H, W) float32 in 0..1."""
    pixels = torch.baddbmm(color[..., 3:], color[..., :3] / 255, image.flatten(2).float())
    return pixels.clamp_(0, 1).unflatten(-1, image.shape[-2:])


def filled_from_each_other(image: Tensor, holes: Tensor) -> Tensor:
    """Fill holes with what other images of the batch show at the same pixels; (B, 3, H, W), (B, H, W) bool.

    A network then learns to answer from the rest of a view, as it must where a query shows what no training frame does.
    """
    known, whole = ~holes, image
    for shift in range(1, min(len(image), _DONORS + 1)):
        donor = ~known & ~holes.roll(shift, 0)
        image = torch.where(donor[:, None], whole.roll(shift, 0), image)
        known = known | donor
    return image


def center_crop(image: Tensor, crop: tuple[int, int]) -> Tensor:
    """Take the middle of a batch; (B, 3, H, W) uint8 -> (B, 3, *crop) float32 in 0..1."""
    top, left = center_corner(image.shape[-2:], crop)
    return image[..., top : top + crop[0], left : left + crop[1]].float() / 255


def centered(batch: PoseBatch, crop: tuple[int, int]) -> PoseBatch:
    """Take the middle of a batch's images, as :func:`center_crop`; intrinsics follow."""
    corner = center_corner(batch.image.shape[-2:], crop)
    return replace(batch, image=center_crop(batch.image, crop), intrinsics=_cropped(batch, *corner))


def _cropped(batch: PoseBatch, top: Tensor | int, left: Tensor | int) -> Tensor | None:
    return None if batch.intrinsics is None else cropped_intrinsics(batch.intrinsics, top, left)


def _crops(image: Tensor, top: Tensor, left: Tensor, crop: tuple[int, int]) -> Tensor:
    if image.device.type == "cpu":  # copying row by row takes a tenth of the time of the gather below
        corners = zip(top.tolist(), left.tolist(), strict=True)
        return torch.stack([i[:, y : y + crop[0], x : x + crop[1]] for i, (y, x) in zip(image, corners, strict=True)])
    windows = image.unfold(2, crop[0], 1).unfold(3, crop[1], 1)  # (B, 3, tops, lefts, *crop), a view
    return windows[torch.arange(len(image), device=image.device), :, top, left]
