"""A set of views: drawn, rendered, and kept where the depth supports them."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mambaloc.console import progress
from mambaloc.errors import InputError
from mambaloc.files import atomic_folder
from mambaloc.memory import release_pages
from mambaloc.synthesis.posed_depth import Floats, PosedDepth
from mambaloc.synthesis.sampling import PoseSampler, Spread
from mambaloc.synthesis.splatting import Splatter

PART = 256
"""Views are kept so many at a time, so that an interrupted run goes on where it was."""

MAX_HOLES = 0.5
"""Share of a view's pixels that no frame sees, beyond which it is thrown away."""

_VERSION = 5
_NEAREST = 0.1  # median depths; nearer surfaces would fill the view with a few pixels of a frame
_MAX_CROWDED = 0.02  # share of pixels nearer than that
_DRAWN = 64  # poses at once
_RENDERED = 16  # of these at once, until there are enough
_MIN_KEPT = 0.02
_REMEDY = "make room, or choose another folder"


@dataclass(frozen=True)
class Views:
    """Views as files that are mapped into memory.

    Shape:
        ``images`` (N, 3, H, W) uint8; ``depth_m`` (N, H, W) float16, NaN where unknown; ``intrinsics`` (N, 3, 3) in
        pixels of the images; ``world_from_cam`` (N, 4, 4), float64.
    """

    images: NDArray[np.uint8]
    depth_m: NDArray[np.float16]
    intrinsics: NDArray[np.float64]
    world_from_cam: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.images)


_FIELDS = ("images", "depth_m", "intrinsics", "world_from_cam")


def make_views(
    source: PosedDepth,
    world_from_cam: Floats,
    intrinsics: Floats,
    size: tuple[int, int],
    count: int,
    root: Path,
    seed: int = 0,
    spread: Spread | None = None,
    device: torch.device | str = "cpu",
) -> Views:
    """Make views, or open those that the same call made before.

    Args:
        source: frames with depth to render from.
        world_from_cam: poses to render about, (P, 4, 4): those of all training frames, with or without depth.
        intrinsics: (3, 3) of the views, in pixels of ``size``.
        size: (height, width) of the views.
        count: how many.
        root: where sets of views are kept, each in a folder of its own name.
        seed: of the poses.
        spread: how far from the frames.
        device: that renders; the views are the same up to rounding.

    Raises:
        InputError: where hardly a view is supported by the depth, or files cannot be written.
    """
    spread = spread or Spread()
    folder = root / _name(source, world_from_cam, intrinsics, size, seed, spread) / f"views-{count}"
    if not folder.is_dir():
        splatter, sampler = Splatter(source, device), PoseSampler(world_from_cam, source.median_depth_m, spread)
        parts = [folder.parent / f"part-{start // PART:04d}" for start in range(0, count, PART)]
        left = [number for number, part in enumerate(parts) if not part.is_dir()]
        with _side_by_side(splatter.device) as pool:
            made = pool.map(lambda number: _accepted(splatter, sampler, intrinsics, size, (seed, number)), left)
            for number, views in zip(left, progress(made, "views", len(left)), strict=True):
                _write(parts[number], views)
        _join(parts, count, folder)
    return Views(*(np.load(folder / f"{name}.npy", mmap_mode="r") for name in _FIELDS))


@contextmanager
def _side_by_side(device: torch.device) -> Iterator[ThreadPoolExecutor]:
    """Threads that make a part each, as many as PyTorch has on a CPU: operations on one view are too small to share."""
    threads = torch.get_num_threads()
    workers = threads if device.type == "cpu" else 1
    pool = ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)  # waits for the parts in hand, a second each
        torch.set_num_threads(threads)  # the threads' setting is that of all new ones


def _name(source: PosedDepth, world_from_cam: Floats, *settings: object) -> str:
    digest = hashlib.sha256(f"{_VERSION} {source.digest()}".encode())
    digest.update(np.ascontiguousarray(world_from_cam, np.float64).tobytes())
    intrinsics, size, seed, spread = settings
    digested = [np.asarray(intrinsics).tolist(), size, seed, astuple(spread)]  # type: ignore[call-overload]
    digest.update(json.dumps(digested).encode())
    return digest.hexdigest()[:32]


def _accepted(
    splatter: Splatter, sampler: PoseSampler, intrinsics: Floats, size: tuple[int, int], seed: tuple[int, int]
) -> Views:
    """A part of the views, which depends on nothing but its arguments."""
    kept: list[tuple[NDArray[np.generic], ...]] = []
    rng, tried = np.random.default_rng(seed), 0
    while len(kept) < PART:
        poses = sampler.draw(_DRAWN, rng)
        tried += _DRAWN
        kept += islice(supported(splatter, poses, intrinsics, size), PART - len(kept))
        if tried > PART and len(kept) < _MIN_KEPT * tried:
            raise InputError(
                f"depth of {len(splatter.source)} frames: supports {len(kept)} of {tried} views. "
                "Give depth to more frames, or do without views."
            )
    images, depth_m, world_from_cam = (np.stack(values) for values in zip(*kept, strict=True))
    return Views(images, depth_m, np.repeat(intrinsics[None].astype(np.float64), PART, axis=0), world_from_cam)


def supported(
    splatter: Splatter, world_from_cam: Floats, intrinsics: Floats, size: tuple[int, int]
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float16], Floats]]:
    """Render views; yield image, depth and pose of those with few holes, whose camera is before the surfaces."""
    free = world_from_cam[splatter.is_free(world_from_cam[:, :3, 3])]
    for start in range(0, len(free), _RENDERED):
        poses = free[start : start + _RENDERED]
        views = splatter.render(poses, np.repeat(intrinsics[None], len(poses), axis=0), size, max_holes=MAX_HOLES)
        crowded_share = (views.depth_m < _NEAREST * splatter.scale_m).float().mean(dim=(1, 2))
        is_good = (views.hole_share <= MAX_HOLES) & (crowded_share <= _MAX_CROWDED)
        for row in is_good.nonzero()[:, 0].tolist():
            yield views.images[row].cpu().numpy(), views.depth_m[row].half().cpu().numpy(), poses[row]


def _write(folder: Path, views: Views) -> None:
    with atomic_folder(folder, _REMEDY) as partial:
        for name in _FIELDS:
            np.save(partial / f"{name}.npy", getattr(views, name))


def _join(parts: list[Path], count: int, folder: Path) -> None:
    with atomic_folder(folder, _REMEDY) as partial:
        for name in _FIELDS:
            first = np.load(parts[0] / f"{name}.npy", mmap_mode="r")
            joined = np.lib.format.open_memmap(
                partial / f"{name}.npy", mode="w+", dtype=first.dtype, shape=(count, *first.shape[1:])
            )
            for start, part in zip(range(0, count, PART), parts, strict=True):
                joined[start : start + PART] = np.load(part / f"{name}.npy", mmap_mode="r")[: count - start]
                release_pages(joined)
            joined.flush()
    for part in parts:
        shutil.rmtree(part)
