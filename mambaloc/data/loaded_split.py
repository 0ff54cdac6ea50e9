"""A part of a scene, decoded: training, validation or test frames."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mambaloc.data.cache import cached_frames
from mambaloc.data.cached_dataset import CachedFrames
from mambaloc.data.frames import BadFrames, Frames
from mambaloc.errors import InputError


@dataclass(frozen=True)
class LoadedSplit:
    """One part of a scene, what was left out of it, and a hash of its images and poses."""

    data: CachedFrames
    bad: BadFrames
    fingerprint: str


def load_split(
    frames: Frames, bad: BadFrames, short_side: int, crop: tuple[int, int], cache_dir: str | None
) -> LoadedSplit:
    """Decode the images of posed frames, once.

    Args:
        frames: to be decoded.
        bad: what to do with an image that cannot be.
        short_side: what the shorter side of every image is resized to, in pixels.
        crop: height and width that will be taken of it.
        cache_dir: where decoded frames are kept; the user's cache folder unless given.

    Raises:
        InputError: as :func:`~mambaloc.data.cache.cached_frames`, and for images that do not hold the crop.
    """
    cache = cached_frames(frames.image_paths, short_side, bad, Path(cache_dir) if cache_dir else None)
    height, width = cache.images.shape[-2:]
    if crop[0] > height or crop[1] > width:
        raise InputError(
            f"data.image_size {crop}: larger than images resized to {width}x{height}; "
            "choose a smaller (height, width), or enlarge data.short_side"
        )
    frames = frames.select(cache.rows)
    fingerprint = hashlib.sha256(f"{cache.key} {frames.digest()}".encode()).hexdigest()
    return LoadedSplit(CachedFrames(frames, cache.images), bad, fingerprint)


def describe_points(parts: Mapping[Any, LoadedSplit]) -> dict[str, Any]:
    """Where parts' scene points come from, and the median of how many a frame has; nothing where none were read."""
    points = {part: loaded.data.points for part, loaded in parts.items() if loaded.data.points}
    if not points:
        return {}
    return {
        "points_source": {part: of.source for part, of in points.items()},
        "points_per_frame": {part: float(np.median(of.per_frame())) for part, of in points.items()},
    }
