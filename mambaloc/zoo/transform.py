"""From an image to what a trained system takes, as in its training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mambaloc.errors import InputError
from mambaloc.images import Image, as_rgb, read_image
from mambaloc.models import LitPoseRegressor
from mambaloc.runtime.contract import Preprocessing


@dataclass(frozen=True)
class Transform:
    """Resize, crop the middle, and scale to 0..1, as test frames are.

    Args:
        preprocessing: the sizes, as exported models state them.
    """

    preprocessing: Preprocessing

    def __call__(self, image: str | Path | Image) -> Tensor:
        """Image to (3, H, W), float32 RGB.

        Args:
            image: a file, which is read upright; or ``uint8`` (H, W, 3) RGB, (H, W) grey or (H, W, 4).

        Raises:
            InputError: if it is truncated or not an image.
        """
        pixels = read_image(image) if isinstance(image, str | Path) else as_rgb(image)
        cropped = self.preprocessing.apply(pixels)
        return torch.from_numpy(np.ascontiguousarray(cropped.transpose(2, 0, 1))).float() / 255


def create_transform(system: LitPoseRegressor) -> Transform:
    """Make the transform of a trained system's images.

    Systems that use a camera's intrinsics then take those of their training camera.

    Examples:
        >>> system = mambaloc.load("denseloc.embedded_room")
        >>> prediction = system(mambaloc.create_transform(system)("image.png")[None])

    Args:
        system: as :func:`mambaloc.load` returns it.

    Raises:
        InputError: for a system that was not trained, which has no size for images yet.
    """
    short_side = system.provenance.get("data", {}).get("short_side")
    if short_side is None:
        raise InputError(f"{system.registry_name}: has no record of its training images. Load a trained system.")
    return Transform(Preprocessing(short_side, system.image_size))
