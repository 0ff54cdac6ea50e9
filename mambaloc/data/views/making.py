"""The views of a scene: made once, kept beside the cached frames, and judged before anything is trained on them."""

from __future__ import annotations

import hashlib
import json
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from filelock import FileLock

from mambaloc.data.depth_frames import INTRINSICS_FILE, depth_path
from mambaloc.data.frame_dataset import LoadedSplit
from mambaloc.data.views.depth import VIEW_DEPTHS, FoundDepth, ViewDepth, depth_of_frames, poses_of
from mambaloc.errors import InputError, InputWarning
from mambaloc.files import atomic_folder
from mambaloc.synthesis import PosedDepth, Quality, Views, held_out_quality, make_views
from mambaloc.user_cache import default_cache_dir, fingerprint

_VERSION = 1
_REMEDY = "set MAMBALOC_CACHE elsewhere"
_META = "meta.json"
_FIELDS = tuple(field.name for field in fields(PosedDepth))

T = TypeVar("T")


@dataclass(frozen=True)
class ViewRequest:
    """Which views are wanted.

    Args:
        count: how many.
        depth: where it comes from.
        share: of views in a batch; three in four, or none, as held-out views match real frames, unless given.
        seed: of their poses.

    Raises:
        InputError: for a value out of range.
    """

    count: int
    depth: ViewDepth
    share: float | None
    seed: int

    def __post_init__(self) -> None:
        if self.count < 0:
            raise InputError(f"data.views {self.count}: must be 0 or more. 0 makes none.")
        if self.depth not in VIEW_DEPTHS:
            raise InputError(f"data.view_depth {self.depth!r}: choose one of {', '.join(VIEW_DEPTHS)}.")
        if self.share is not None and not 0 <= self.share < 1:
            raise InputError(f"data.view_share {self.share:g}: must be 0 or more and less than 1.")


@dataclass(frozen=True)
class SceneViews:
    """Views of a scene, and how good they are.

    Args:
        source: training frames with depth, which views are made from.
        kind: of their depth, ``sensor`` or ``pictures``.
        quality: of views at the poses of real frames.
        share: of views in a batch; 0 where they are not trained on.
        views: None where the share is 0.
        seconds: that it took to make them, now or before.
    """

    source: PosedDepth
    kind: str
    quality: Quality
    share: float
    views: Views | None
    seconds: float

    def summary(self) -> str:
        """How many views there are, from what, and how good they are, in one line."""
        count = 0 if self.views is None else len(self.views)
        made_of = {"sensor": "depth frames", "pictures": "frames, whose depth was searched in the images"}
        return (
            f"{count} views of {len(self.source)} {made_of[self.kind]}; {self.quality.describe()}; "
            f"made in {self.seconds:.0f} s"
        )

    def describe(self) -> dict[str, Any]:
        """Describe the views for a result."""
        return {
            "count": 0 if self.views is None else len(self.views),
            "depth": self.kind,
            "depth_frames": len(self.source),
            "correlation": round(self.quality.correlation, 4),
            "share": self.share,
            "seconds": round(self.seconds, 2),
        }


def make_scene_views(
    folder: Path, train: LoadedSplit, request: ViewRequest, cache_dir: str | None, device: torch.device
) -> SceneViews:
    """Make views of training frames at their cached size, or open those that were made before.

    Args:
        folder: the scene's.
        train: its training frames.
        request: which views.
        cache_dir: where decoded frames are kept; the user's cache folder unless given.
        device: that makes them.

    Raises:
        InputError: where there is no depth that fits the poses, or the cache cannot be written.
    """
    root = (Path(cache_dir) if cache_dir else default_cache_dir()) / "views"
    kept = root / _key(folder, train, request.depth)
    try:
        root.mkdir(parents=True, exist_ok=True)
        with FileLock(kept.with_suffix(".lock")):  # another process may make the same
            return _made(folder, train, request, kept, device)
    except OSError as error:
        raise InputError(f"{root}: views cannot be written ({error}). {_REMEDY.capitalize()}.") from None


def _made(folder: Path, train: LoadedSplit, request: ViewRequest, kept: Path, device: torch.device) -> SceneViews:
    data = train.data
    if not (kept / "depth").is_dir():
        found, taken_s = _timed(lambda: depth_of_frames(folder, data, request.depth, device))
        _keep_depth(found, taken_s, kept / "depth")
    found, seconds = _open_depth(kept / "depth")
    for line in found.left_out:
        warnings.warn(line, InputWarning, stacklevel=2)
    quality = held_out_quality(found.frames, device=device)
    share = quality.share if request.share is None else request.share
    if share == 0 or request.count == 0:
        return SceneViews(found.frames, found.kind, quality, 0.0, None, seconds)
    intrinsics, size = data.intrinsics.double().cpu().numpy(), (data.images.shape[2], data.images.shape[3])
    usual = intrinsics[np.argsort(intrinsics[:, 0, 0], kind="stable")[len(intrinsics) // 2]]
    views, taken_s = _timed(
        lambda: make_views(
            found.frames, poses_of(data.frames), usual, size, request.count, kept, request.seed, device=device
        )
    )
    note = kept / f"views-{request.count}-{request.seed}.json"
    if not note.is_file():
        note.write_text(json.dumps({"seconds": taken_s}))
    seconds += json.loads(note.read_text())["seconds"]
    return SceneViews(found.frames, found.kind, quality, share, views, seconds)


def _timed(make: Callable[[], T]) -> tuple[T, float]:
    started = time.perf_counter()
    return make(), time.perf_counter() - started


def _keep_depth(found: FoundDepth, seconds: float, folder: Path) -> None:
    with atomic_folder(folder, _REMEDY) as partial:
        for name in _FIELDS:
            np.save(partial / f"{name}.npy", getattr(found.frames, name))
        meta = {"kind": found.kind, "left_out": found.left_out, "seconds": seconds}
        (partial / _META).write_text(json.dumps(meta))


def _open_depth(folder: Path) -> tuple[FoundDepth, float]:
    meta = json.loads((folder / _META).read_text())
    frames = PosedDepth(*(np.load(folder / f"{name}.npy") for name in _FIELDS))
    return FoundDepth(meta["kind"], frames, meta["left_out"]), meta["seconds"]


def _key(folder: Path, train: LoadedSplit, depth: ViewDepth) -> str:
    """Name what depth is made from: training frames, their cameras, and the files of their depth."""
    digest = hashlib.sha256(f"{_VERSION} {depth} {train.fingerprint}".encode())
    digest.update(train.data.intrinsics.cpu().numpy().tobytes())
    if depth != "pictures":
        for file in (folder / INTRINSICS_FILE, *map(depth_path, train.data.frames.image_paths)):
            digest.update(fingerprint(file))
    return digest.hexdigest()[:32]
