"""Keypoints and matches of key frames, kept in the user's cache: a build goes on where an earlier one stopped.

Each part is named by what it was made from: images, width, and the version of OpenCV. Builds that differ in poses,
cameras, budgets or the number of key frames share what is the same. Images that are not files are searched each time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.images import Image, as_rgb, read_image
from mambaloc.mapping.tracks import match
from mambaloc.runtime.maps.features import Features, Keypoints, find_keypoints
from mambaloc.user_cache import cached_arrays, fingerprint

Indices = NDArray[np.int64]

_VERSION = f"1 OpenCV {cv2.__version__}"


def image_name(image: Path | Image, width: int) -> str | None:
    """What the keypoints of an image are kept under; None for an array, whose keypoints are not kept."""
    return _digest(str(width).encode(), fingerprint(image)) if isinstance(image, Path) else None


def kept_keypoints(image: Path | Image, width: int, name: str | None) -> Keypoints:
    """Keypoints of an image.

    Args:
        image: path or RGB array (H, W, 3).
        width: of the image in which they are searched, in pixels; a narrower one is searched as it is.
        name: as :func:`image_name` gives it.

    Raises:
        InputError: for a bad image, or where the cache cannot be written.
    """

    def make() -> dict[str, NDArray[Any]]:
        rgb = read_image(image) if isinstance(image, Path) else as_rgb(image)
        return find_keypoints(rgb, width / rgb.shape[1])._asdict()

    return Keypoints(**_kept(name and f"keypoints/{name}", make))


def kept_matches(features: Sequence[Features], names: Sequence[str | None]) -> list[Indices]:
    """Matches of the first image's keypoints with those of each other one, rows of both (M, 2).

    Args:
        features: of the images.
        names: of the images, as :func:`image_name` gives them.

    Raises:
        InputError: where the cache cannot be written.
    """
    first, *others = features
    known = [name.encode() for name in names if name is not None]
    name = f"matches/{_digest(*known)}" if len(known) == len(names) else None
    return list(_kept(name, lambda: {str(row): match(first, each) for row, each in enumerate(others)}).values())


def _kept(name: str | None, make: Callable[[], dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    return cached_arrays(name, make) if name else make()


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"\0".join((_VERSION.encode(), *parts))).hexdigest()[:32]
