"""Batches of training frames and views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DistributedSampler

from mambaloc.data.frame_dataset import CachedFrames
from mambaloc.data.points import ScenePoints
from mambaloc.data.views.pool import ViewPool
from mambaloc.errors import InputError
from mambaloc.memory import release_pages
from mambaloc.runtime.rotations import quaternion_from_matrix
from mambaloc.synthesis import Views
from mambaloc.types import PoseBatch


class FramesAndViews(CachedFrames):
    """Training frames and, in the rows after them, views of the same size.

    Args:
        real: the frames, each an item of its own.
        views: V views.
        share: of views in a batch, more than 0 and less than 1.
        points: what each view shows, if the frames carry points.
    """

    def __init__(self, real: CachedFrames, views: Views, share: float, points: ScenePoints | None = None) -> None:
        super().__init__(real.frames, real.images, real.cameras, real.points)
        self.views, self.share = ViewPool(views), share
        self.resident_holes: Tensor | None = None
        pose = views.world_from_cam
        self.position_m = _joined(self.position_m, pose[:, :3, 3])
        self.quaternion = _joined(self.quaternion, quaternion_from_matrix(pose[:, :3, :3]))
        self.intrinsics = _joined(self.intrinsics, views.intrinsics)
        if self.points_m is not None and points is not None:
            self.points_m = _joined(self.points_m, points.points_m)
        self.clips = np.arange(len(self.frames) + len(views))[:, None]

    @property
    def nbytes(self) -> int:
        """Of all images."""
        return self.images.nbytes + self.views.nbytes

    def images_at(self, rows: Sequence[int] | NDArray[np.int64]) -> NDArray[np.uint8]:
        """Images of some rows, frames' and views', (B, 3, H, W)."""
        rows = np.asarray(rows)
        is_view = rows >= len(self.frames)
        images = np.empty((len(rows), *self.images.shape[1:]), np.uint8)
        images[~is_view] = self.images[rows[~is_view]]
        release_pages(self.images)
        images[is_view] = self.views.images(rows[is_view] - len(self.frames))
        return images

    def replace_views(self, rows: NDArray[np.int64], views: Views, points: ScenePoints | None = None) -> None:
        """Put N views in the place of those in N rows, with the points that each shows if the frames carry points."""
        device, pose = self.position_m.device, views.world_from_cam
        self.views.replace(rows - len(self.frames), views)
        self.position_m[rows] = _like(self.position_m, pose[:, :3, 3])
        self.quaternion[rows] = _like(self.quaternion, quaternion_from_matrix(pose[:, :3, :3]))
        self.intrinsics[rows] = _like(self.intrinsics, views.intrinsics)
        if self.points_m is not None and points is not None:
            self.points_m[rows] = _like(self.points_m, points.points_m)
        if self.resident is not None and self.resident_holes is not None:
            self.resident[rows] = torch.from_numpy(self.images_at(rows)).to(device)
            self.resident_holes[rows] = torch.from_numpy(self.holes(rows)).to(device)

    def to(self, device: torch.device) -> Self:
        """Return the same frames and views, whole in a device's memory."""
        there = super().to(device)
        there.views = self.views.copy()
        there.resident_holes = torch.from_numpy(self.holes(range(len(self.clips)))).to(device)
        return there

    def holes(self, rows: Sequence[int] | NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which pixels of some rows show nothing of the scene, (B, H, W): those of views without depth."""
        rows = np.asarray(rows)
        is_view = rows >= len(self.frames)
        holes = np.zeros((len(rows), *self.images.shape[2:]), dtype=bool)
        holes[is_view] = self.views.holes(rows[is_view] - len(self.frames))
        return holes

    def __getitems__(self, items: list[int]) -> PoseBatch:
        """Fetch frames and views: as frames are, and with ``holes`` (B, H, W)."""
        batch = super().__getitems__(items)
        if self.resident_holes is None:
            return replace(batch, holes=torch.from_numpy(self.holes(items)))
        return replace(batch, holes=self.resident_holes[batch.index])


def _joined(real: Tensor, views: NDArray[np.floating]) -> Tensor:
    return torch.cat((real, _like(real, views)))


def _like(real: Tensor, values: NDArray[np.floating]) -> Tensor:
    return torch.from_numpy(np.array(values)).to(real)


class MixedSampler(DistributedSampler[int]):
    """Rows of batches that mix frames and views: an epoch is a pass over the frames.

    Which rows a batch has depends on (seed, epoch) alone. Views go on where the epoch before stopped, each as often as
    any other.

    Args:
        data: of which it draws rows; each batch has both.
        batch_size: rows of a batch, on each device.
        num_replicas: devices.
        rank: of this one.
        seed: of the order.

    Raises:
        InputError: for a batch of one row.
    """

    def __init__(self, data: FramesAndViews, batch_size: int, num_replicas: int, rank: int, seed: int) -> None:
        super().__init__(range(len(data.frames)), num_replicas, rank, shuffle=True, seed=seed)  # type: ignore[arg-type]
        if batch_size < 2:
            raise InputError(
                "data.batch_size 1: is too small for a frame and a view. Increase it, or set data.views to 0."
            )
        self.first, self.views, self.batch_size = len(data.frames), len(data.views), batch_size
        self.real_per_batch = batch_size - min(max(round(data.share * batch_size), 1), batch_size - 1)

    def __len__(self) -> int:
        return self.batch_size * -(-self.num_samples // self.real_per_batch)

    def __iter__(self) -> Iterator[int]:
        """Frames, then views of each batch; the last batch has fewer frames where they run out."""
        real, views = list(super().__iter__()), iter(self._views_of_epoch())
        for start in range(0, len(real), self.real_per_batch):
            batch = real[start : start + self.real_per_batch]
            yield from batch
            for _ in range(self.batch_size - len(batch)):
                yield next(views)

    def _views_of_epoch(self) -> list[int]:
        """This device's rows of views out of one endless sequence of shuffled passes."""
        needed = (len(self) - self.num_samples) * self.num_replicas
        turns = np.arange(self.epoch * needed, (self.epoch + 1) * needed)[self.rank :: self.num_replicas]
        number, place = np.divmod(turns, self.views)
        orders = {n: np.random.default_rng((self.seed, n)).permutation(self.views) for n in np.unique(number).tolist()}
        return [self.first + int(orders[n][at]) for n, at in zip(number.tolist(), place.tolist(), strict=True)]
