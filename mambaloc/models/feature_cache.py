"""Features of frozen layer groups, computed once for each augmented training image, in a file mapped into memory."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mambaloc.errors import InputError
from mambaloc.files import claim_space
from mambaloc.memory import release_pages
from mambaloc.nn import SplitBackbone
from mambaloc.types import PoseBatch
from mambaloc.user_cache import cached_folder

_REMEDY = "make room, set MAMBALOC_CACHE elsewhere, or set model.feature_cache_gib to 0"


class FeatureCache:
    """Keeps what a function gives for images, as float16; the row and the draw of its augmentation name an image.

    Features are computed when they are first asked for, so that an interrupted training loses none, and those that find
    no room are computed each time.

    Args:
        compute: images (B, 3, H, W) to features, a few (B, C, h, w).
        sample: one image, (1, 3, H, W), whose features have the shapes to expect.
        rows: how many training images there are.
        draws: how many augmentations each has.
        max_bytes: of the file.
        key: names whatever else the features depend on.
        cache_dir: where it is kept; the user's cache folder unless given.

    Raises:
        InputError: where the file cannot be written.
    """

    def __init__(
        self,
        compute: Callable[[Tensor], list[Tensor]],
        sample: Tensor,
        rows: int,
        draws: int,
        max_bytes: int,
        key: str,
        cache_dir: Path | None = None,
    ) -> None:
        self.compute, self.rows, self.draws = compute, rows, draws
        self.shapes = [tuple(each.shape[1:]) for each in compute(sample)]
        self._sizes = [math.prod(shape) for shape in self.shapes]
        room = min(rows * draws, max_bytes // (2 * sum(self._sizes)))
        name = hashlib.sha256(f"{key} {self.shapes} {rows} {room}".encode()).hexdigest()[:32]

        def make(empty: Path) -> None:
            _make_file(empty / "features.npy", np.float16, (room, sum(self._sizes)))
            _make_file(empty / "is_kept.npy", np.bool_, (room,))

        folder = cached_folder(f"features/{name}", make, cache_dir, _REMEDY)
        self.features, self.is_kept = (
            np.load(folder / f"{file}.npy", mmap_mode="r+") for file in ("features", "is_kept")
        )

    @classmethod
    def of_training(cls, data: Any, split: SplitBackbone, device: torch.device, max_bytes: int) -> FeatureCache:
        """Open the cache of a training.

        Args:
            data: the data module, whose training batches were asked for.
            split: whose frozen part is kept.
            device: where it computes.
            max_bytes: of the file.

        Raises:
            InputError: where images are augmented in a new way each epoch.
        """
        draws = data.hparams["augmentation_draws"]
        if draws is None:
            raise InputError(
                "model.feature_cache_gib: images are augmented in a new way each epoch. Set data.augmentation_draws, "
                "for instance to 4."
            )
        digest = hashlib.sha256(data.training_key().encode())
        for name, value in split.frozen_state().items():
            digest.update(name.encode() + value.cpu().numpy().tobytes())
        cache_dir = data.hparams["cache_dir"]
        sample = torch.zeros(1, 3, *data.crop, device=device)
        rows = len(data.scene.items("train").position_m)
        return cls(
            split.frozen, sample, rows, draws, max_bytes, digest.hexdigest(), Path(cache_dir) if cache_dir else None
        )

    def __call__(self, batch: PoseBatch, epoch: int) -> list[Tensor]:
        """Features of a batch's augmented images, on their device, as float32."""
        places = (epoch % self.draws) * self.rows + batch.index.cpu().numpy()
        is_kept = self._kept(places)
        found = np.empty((len(places), sum(self._sizes)), np.float16)
        found[is_kept] = self.features[places[is_kept]]
        if not is_kept.all():
            image = batch.image[torch.from_numpy(~is_kept).to(batch.image.device)]
            new = torch.cat([each.flatten(1) for each in self.compute(image)], dim=1).half().cpu().numpy()
            found[~is_kept] = new
            self._keep(places[~is_kept], new)
        release_pages(self.features)
        flat = torch.from_numpy(found).to(batch.image.device).float()
        parts = zip(flat.split(self._sizes, dim=1), self.shapes, strict=True)
        return [part.unflatten(1, shape) for part, shape in parts]

    def _kept(self, places: NDArray[np.int64]) -> NDArray[np.bool_]:
        has_room = places < len(self.is_kept)
        return has_room & self.is_kept[np.where(has_room, places, 0)] if len(self.is_kept) else has_room

    def _keep(self, places: NDArray[np.int64], new: NDArray[np.float16]) -> None:
        has_room = places < len(self.is_kept)
        self.features[places[has_room]] = new[has_room]
        self.is_kept[places[has_room]] = True  # after the features: a process that is killed marks nothing half-written


def _make_file(path: Path, dtype: Any, shape: tuple[int, ...]) -> None:
    np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape).flush()
    claim_space(path)
