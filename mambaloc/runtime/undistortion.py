"""Images as a camera stores them, made those of a pinhole: one function for training images and for queries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.images import LARGEST_SIDE_PX, Image
from mambaloc.runtime.camera_models import (
    CameraModel,
    Floats,
    Pinhole,
    Size,
    is_same_shape,
    model_from_json,
    model_to_json,
    numbers_to_json,
    pinhole_from_json,
    scaled_intrinsics,
)

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Columns and rows (H, W) of the stored image, one of each for each pixel of the pinhole's."""

FUNCTION = (
    "each pixel of 'leaves' is sampled where 'lens' projects its ray: OpenCV's initUndistortRectifyMap "
    "(cv2.fisheye's for a fisheye) as float32, then remap with INTER_LINEAR and BORDER_REPLICATE"
)
_MAPS_KEPT = 2  # each is as large as a few images


@dataclass(frozen=True)
class Undistortion:
    """How a scene's images were made of what their camera stored, where that is known and the same for all.

    Args:
        lens: of the camera; None where it is not known.
        stored: (width, height) of the images that it stores.
        leaves: the pinhole camera of the undistorted images, of their middle if they were cropped.
        unknown: why the lens is not known.
    """

    lens: CameraModel | None = None
    stored: Size = (0, 0)
    leaves: Pinhole | None = None
    unknown: str = "none was kept with it"

    def apply(self, image: Image, where: str) -> tuple[Image, Floats]:
        """Undistort an image as the camera stores it, whole or resized.

        Args:
            image: (H, W, 3) or (H, W), ``uint8``.
            where: what carries this, for messages.

        Returns:
            The image as the scene's are, of their size times what this one was resized by; and its pinhole matrix,
            (3, 3).

        Raises:
            InputError: where the lens is not known, or the image has another shape than those that the camera stores.
        """
        size = image.shape[1], image.shape[0]
        if self.lens is None or self.leaves is None:
            raise InputError(
                f"{where}: the lens of its images is not known ({self.unknown}). Give images without distortion."
            )
        if not is_same_shape(self.stored, size):
            (width, height), (own_width, own_height) = size, self.stored
            raise InputError(
                f"{where}: an image of {width}x{height} has another shape than {own_width}x{own_height}, which its "
                "camera stores. Give whole images of that camera, or undistorted ones with their intrinsics."
            )
        maps, pinhole = _fitted(self.lens, self.stored, self.leaves, size)
        return undistorted(image, maps), pinhole.intrinsics

    def to_json(self) -> dict[str, Any]:
        """What :meth:`from_json` reads."""
        left = self.leaves
        if self.lens is None or left is None:
            return {"lens": {"opencv": None, "unknown": self.unknown}}
        return {
            "function": FUNCTION,
            "lens": model_to_json(self.lens, self.stored),
            "leaves": numbers_to_json(left.size, left.focal_px, left.center_px),
        }

    @classmethod
    def from_json(cls, value: Any) -> Undistortion:
        """Read what :meth:`to_json` gives, or ``scene.json`` has; no lens where an older file has none.

        Raises:
            ValueError: for anything else.
        """
        if value is None:
            return cls()
        try:
            if value["lens"].get("opencv") is None:
                return cls(unknown=str(value["lens"].get("unknown", cls.unknown)))
            (lens, stored), left = model_from_json(value["lens"]), pinhole_from_json(value["leaves"])
        except (TypeError, KeyError, ValueError, OverflowError, AttributeError) as error:
            raise ValueError(f"lens: {type(error).__name__}: {error}") from None
        if left.width > stored[0] or left.height > stored[1]:
            raise ValueError("lens: it leaves larger images than it is given")
        corners = np.array([(x, y) for x in (0.0, left.width - 1) for y in (0.0, left.height - 1)])
        seen = lens((corners - left.center_px) / left.focal_px)
        if not ((seen > -1) & (seen < stored)).all():
            raise ValueError("lens: its images do not fill those that are left")
        return cls(lens, stored, left, "")


def undistorted(image: Image, maps: Maps) -> Image:
    """A stored image as a pinhole shows it, by what :func:`sampled_at` gives."""
    # The border's last hundredth of a pixel is rounding, and nothing to be black.
    return cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[return-value]


def sampled_at(projected: Callable[[Floats], Floats], pinhole: Pinhole) -> Maps:
    """Where each pixel of a pinhole's image lies in the stored one.

    Args:
        projected: stored pixels (N, 2) of rays (N, 2), such as a :class:`~mambaloc.runtime.camera_models.CameraModel`.
        pinhole: of the image that is wanted.
    """
    if isinstance(projected, CameraModel):
        seen: NDArray[np.floating[Any]] = projected.of_pixels(pinhole)
    else:
        columns, rows = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
        pixels = np.stack((columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
        seen = projected((pixels - pinhole.center_px) / pinhole.focal_px).reshape(pinhole.height, pinhole.width, 2)
    # What no lens sees is outside.
    seen = np.clip(np.nan_to_num(seen, nan=-1.0), -LARGEST_SIDE_PX, 2 * LARGEST_SIDE_PX).astype(np.float32)
    return np.ascontiguousarray(seen[..., 0]), np.ascontiguousarray(seen[..., 1])


@lru_cache(_MAPS_KEPT)
def _fitted(lens: CameraModel, stored: Size, left: Pinhole, size: Size) -> tuple[Maps, Pinhole]:
    """Maps of a stored image that was resized to (width, height), and the pinhole that they leave."""
    if size != stored:
        scale = size[0] / stored[0], size[1] / stored[1]
        width, height = (max(1, round(side * by)) for side, by in zip(left.size, scale, strict=True))
        by = width / left.width, height / left.height
        lens, left = lens.scaled(scale), Pinhole(width, height, *scaled_intrinsics(left.focal_px, left.center_px, by))
    return sampled_at(lens, left), left
