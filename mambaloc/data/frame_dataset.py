"""Frames of one part of a scene, decoded, as a dataset that is fetched a batch at a time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from mambaloc.data.cache import cached_frames
from mambaloc.data.cameras import assumed_intrinsics
from mambaloc.data.frames import BadFrames, Cameras, Frames
from mambaloc.data.points import ScenePoints
from mambaloc.errors import InputError
from mambaloc.geometry import cropped_intrinsics, resized_intrinsics
from mambaloc.images import center_corner, resized_size
from mambaloc.memory import release_pages
from mambaloc.types import PoseBatch


class CachedFrames(Dataset[PoseBatch]):
    """Frames of one part of a scene, already decoded; an item is a frame, or a clip of frames.

    Args:
        frames: N posed frames.
        images: the same, decoded: (N, 3, H, W).
        cameras: of the frames.
        points: what each may see, if batches are to carry it.
        clips: the frames of each item, (C, length); each frame by itself unless given.
    """

    def __init__(
        self,
        frames: Frames,
        images: NDArray[np.uint8],
        cameras: Cameras,
        points: ScenePoints | None = None,
        clips: NDArray[np.int64] | None = None,
    ) -> None:
        self.frames, self.images, self.cameras, self.points = frames, images, cameras, points
        self.resident: Tensor | None = None
        self.clips = np.arange(len(frames))[:, None] if clips is None else clips
        self.position_m = torch.from_numpy(frames.position_m).float()
        self.quaternion = torch.from_numpy(frames.quaternion).float()
        width, height = torch.from_numpy(cameras.size_px).unbind(dim=1)
        scale = (images.shape[-1] / width, images.shape[-2] / height)
        self.intrinsics = resized_intrinsics(torch.from_numpy(cameras.intrinsics), *scale).float()
        self.points_m = torch.from_numpy(points.points_m) if points else None

    def __len__(self) -> int:
        return len(self.clips)

    @property
    def nbytes(self) -> int:
        """Of all images."""
        return self.images.nbytes

    def images_at(self, rows: Sequence[int] | NDArray[np.int64]) -> NDArray[np.uint8]:
        """Decoded images of some rows, (B, 3, H, W)."""
        images = np.stack([self.images[row] for row in rows])
        release_pages(self.images)
        return images

    def to(self, device: torch.device) -> Self:
        """Return the same frames, whole in a device's memory: batches are made there, and nothing is copied to it."""
        there = copy(self)
        there.resident = torch.from_numpy(self.images_at(range(len(self.position_m)))).to(device)
        for name in ("position_m", "quaternion", "points_m", "intrinsics"):
            if (values := getattr(self, name)) is not None:
                setattr(there, name, values.to(device))
        return there

    def __getitems__(self, items: list[int]) -> PoseBatch:
        """Fetch items, clip after clip: ``image`` (B, 3, H, W) uint8 as cached, uncropped, with its ``intrinsics``."""
        rows = self.clips[items].ravel()
        index = torch.from_numpy(rows).to(self.position_m.device, non_blocking=True)
        return PoseBatch(
            torch.from_numpy(self.images_at(rows)) if self.resident is None else self.resident[index],
            self.position_m[index],
            self.quaternion[index],
            index,
            clip_length=self.clips.shape[1],
            points_m=None if self.points_m is None else self.points_m[index],
            intrinsics=self.intrinsics[index],
        )


@dataclass(frozen=True)
class LoadedSplit:
    """One part of a scene, what was left out of it, and a hash of its images and poses."""

    data: CachedFrames
    bad: BadFrames
    fingerprint: str


def load_split(
    frames: Frames,
    bad: BadFrames,
    cameras_of: Callable[[Frames], Cameras],
    short_side: int,
    crop: tuple[int, int],
    cache_dir: str | None,
    is_mixed: bool = False,
) -> LoadedSplit:
    """Decode the images of posed frames, once.

    Args:
        frames: to be decoded.
        bad: what to do with an image that cannot be.
        cameras_of: the cameras of those that could be.
        short_side: what the shorter side of every image is resized to, in pixels.
        crop: height and width that will be taken of it.
        cache_dir: where decoded frames are kept; the user's cache folder unless given.
        is_mixed: images may be of several shapes, of which the middle that all hold is kept, and cameras are of that.

    Raises:
        InputError: as :func:`~mambaloc.data.cache.cached_frames`, for images that do not hold the crop, and for cameras
            of images of another shape.
    """
    folder = Path(cache_dir) if cache_dir else None
    cache = cached_frames(frames.image_paths, short_side, bad, folder, crop if is_mixed else None)
    height, width = cache.images.shape[-2:]
    if crop[0] > height or crop[1] > width:
        raise InputError(
            f"data.image_size {crop}: larger than images resized to {width}x{height}; "
            "choose a smaller (height, width), or enlarge data.short_side"
        )
    frames = frames.select(cache.rows)
    cameras = cameras_of(frames)
    if is_mixed and cameras.is_assumed:
        sizes_px = np.flip(cache.sizes, axis=1)
        usual = np.stack([assumed_intrinsics((width, height)) for width, height in sizes_px.tolist()])
        cameras = Cameras(usual, sizes_px.copy(), is_assumed=True)
    for row, (wide, high) in enumerate(cameras.size_px.tolist()):
        if resized_size((high, wide), short_side) != tuple(cache.sizes[row].tolist()):
            raise InputError(
                f"{frames.image_paths[row]}: has another shape than its camera's {wide}x{high} pixels. "
                "Give the intrinsics of this image."
            )
    if (cache.sizes != (height, width)).any():
        cameras = _of_middle(cameras, cache.sizes, (height, width))
    fingerprint = hashlib.sha256(f"{cache.key} {frames.digest()}".encode()).hexdigest()
    return LoadedSplit(CachedFrames(frames, cache.images, cameras), bad, fingerprint)


def _of_middle(cameras: Cameras, sizes: NDArray[np.int64], crop: tuple[int, int]) -> Cameras:
    """Cameras of the middle (height, width) of images that were resized to sizes (N, 2)."""
    size_px, resized = torch.from_numpy(cameras.size_px), torch.from_numpy(sizes).flip(1)
    scale_x, scale_y = (resized / size_px).unbind(dim=1)
    intrinsics = resized_intrinsics(torch.from_numpy(cameras.intrinsics), scale_x, scale_y)
    corners = torch.tensor([center_corner(size, crop) for size in sizes.tolist()])
    intrinsics = cropped_intrinsics(intrinsics, *corners.unbind(dim=1))
    return replace(cameras, intrinsics=intrinsics.numpy(), size_px=np.tile(crop[::-1], (len(sizes), 1)))


def describe_points(parts: Mapping[Any, LoadedSplit]) -> dict[str, Any]:
    """Where parts' scene points come from, and the median of how many a frame has; nothing where none were read."""
    points = {part: loaded.data.points for part, loaded in parts.items() if loaded.data.points}
    if not points:
        return {}
    return {
        "points_source": {part: of.source for part, of in points.items()},
        "points_per_frame": {part: float(np.median(of.per_frame())) for part, of in points.items()},
    }
