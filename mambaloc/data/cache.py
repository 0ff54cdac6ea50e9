"""Decode every image once: frames resized to a short side, kept as one uint8 memory map.

A cache is keyed by what it was made from (each image's name, size, first and last 4 KiB) and how (settings), so moving
a scene keeps it and changing an image or a setting makes a new one. It is built under a lock in a folder of its own and
renamed into place when complete: a killed run leaves nothing that is ever read, and two processes build it once.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray
from rich.progress import track

from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError
from mambaloc.exif import unclear_pose
from mambaloc.files import claim_space
from mambaloc.images import center_cropped, decode_image, resized
from mambaloc.memory import release_pages
from mambaloc.user_cache import default_cache_dir, fingerprint

_VERSION = 2
_AT_ONCE = 128  # frames that are decoded ahead, and mapped

Shape = tuple[int, ...]


@dataclass(frozen=True)
class FrameCache:
    """Decoded frames of a list of images.

    Shape:
        ``images`` (K, 3, H, W) uint8 RGB, read-only and memory-mapped; ``rows`` (K,), which image of the list each is:
        K is smaller than the list where bad images were left out.

    ``sizes`` (K, 2) is the height and width of each once it was resized; of frames of several shapes, ``images`` has
    the middle that all hold. ``key`` names what the images were and how they were resized.
    """

    images: NDArray[np.uint8]
    rows: NDArray[np.int64]
    key: str
    sizes: NDArray[np.int64]


def cached_frames(
    paths: Sequence[Path],
    short_side: int,
    bad: BadFrames,
    cache_dir: Path | None = None,
    min_size: tuple[int, int] | None = None,
) -> FrameCache:
    """Open the cache of some images, building it first if it is missing.

    Args:
        paths: the images, in order.
        short_side: height or width, whichever is smaller, in pixels, that images are resized to.
        bad: what to do with an image that is missing, truncated, or of another shape than the first.
        cache_dir: where caches are kept.
        min_size: of frames of several shapes the middle that all hold is kept, if it has this height and width; unless
            given, another shape than the first is bad.

    Raises:
        InputError: for a bad image where ``bad`` says so, no good image at all, or a full disk.
    """
    root = (cache_dir or default_cache_dir()) / "frames"
    folder = root / _key(paths, short_side, min_size)
    if not folder.is_dir():
        try:
            root.mkdir(parents=True, exist_ok=True)
            with FileLock(folder.with_suffix(".lock")):
                if not folder.is_dir():  # another process may have built it meanwhile
                    _build(folder, paths, short_side, min_size)
        except OSError as error:
            message = f"{root}: the frame cache cannot be written ({error}); set MAMBALOC_CACHE elsewhere"
            raise InputError(message) from None
    meta = json.loads((folder / "meta.json").read_text(encoding="utf-8"))
    for row, rule in meta["bad"]:
        bad.reject(paths[row], rule)
    if not meta["rows"]:
        raise InputError(f"{paths[0].parent}: none of {len(paths)} images can be decoded")
    rows = np.array(meta["rows"], dtype=np.int64)
    images = np.load(folder / "images.npy", mmap_mode="r")[: len(rows)]
    return FrameCache(images, rows, folder.name, np.array(meta["sizes"], dtype=np.int64))


def _key(paths: Sequence[Path], short_side: int, min_size: tuple[int, int] | None) -> str:
    digest = hashlib.sha256(f"{_VERSION} {short_side} {min_size}".encode())
    with ThreadPoolExecutor() as pool:
        for path, content in zip(paths, pool.map(fingerprint, paths), strict=True):
            digest.update(f"{path.parent.name}/{path.name}\0".encode())
            digest.update(content)
    return digest.hexdigest()[:32]


def _build(folder: Path, paths: Sequence[Path], short_side: int, min_size: tuple[int, int] | None) -> None:
    partial = folder.with_suffix(".partial")  # only this process has it: the lock is held
    held: Shape | None = None
    meta: dict[str, Any] | None = None
    while meta is None:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        meta, held = _fill(partial / "images.npy", paths, short_side, held, min_size)
    (partial / "meta.json").write_text(json.dumps({**meta, "short_side": short_side}))
    partial.replace(folder)


def _fill(
    file: Path, paths: Sequence[Path], short_side: int, held: Shape | None, min_size: tuple[int, int] | None
) -> tuple[dict[str, Any] | None, Shape | None]:
    """Decode frames into a file, each cropped to a shape that all hold: the first one's unless given.

    Returns:
        Where the frames are in the cache; or None and a smaller shape to begin again with.
    """
    images: np.memmap[Any, np.dtype[np.uint8]] | None = None
    rows: list[int] = []
    sizes: list[Shape] = []
    bad: list[tuple[int, str]] = []
    for row, frame in enumerate(_with_progress(_decoded(paths, short_side), len(paths))):
        if isinstance(frame, str):
            bad.append((row, frame))
            continue
        if images is None:
            held = held or frame.shape
            images = np.lib.format.open_memmap(file, mode="w+", dtype=np.uint8, shape=(len(paths), *held))
            claim_space(file)
        common = tuple(map(min, frame.shape, images.shape[1:]))
        if frame.shape != images.shape[1:] and (min_size is None or common[1] < min_size[0] or common[2] < min_size[1]):
            bad.append((row, f"image is {_size(frame)} after resizing, where the first is {_size(images[0])}"))
            continue
        if common != images.shape[1:]:
            return None, common
        images[len(rows)] = center_cropped(frame.transpose(1, 2, 0), common[1:]).transpose(2, 0, 1)
        rows.append(row)
        sizes.append(frame.shape[1:])
        if len(rows) % _AT_ONCE == 0:
            release_pages(images)
    if images is not None:
        images.flush()
    return {"rows": rows, "bad": bad, "sizes": sizes}, held


def _decoded(paths: Sequence[Path], short_side: int) -> Iterator[NDArray[np.uint8] | str]:
    """Decode images in order, a few ahead: the caller may be slower than all cores together."""
    with ThreadPoolExecutor() as pool:
        for start in range(0, len(paths), _AT_ONCE):
            yield from pool.map(lambda path: _decode(path, short_side), paths[start : start + _AT_ONCE])


def _decode(path: Path, short_side: int) -> NDArray[np.uint8] | str:
    """Return an image as (3, H, W) RGB at the short side, or the rule it breaks."""
    try:
        data = path.read_bytes()
    except OSError:
        return "image cannot be read"
    if rule := unclear_pose(data):
        return rule
    image = decode_image(data)
    if isinstance(image, str):
        return image
    return np.ascontiguousarray(resized(image, short_side).transpose(2, 0, 1))


def _size(frame: NDArray[np.uint8]) -> str:
    return f"{frame.shape[-1]}x{frame.shape[-2]}"


def _with_progress(frames: Iterable[NDArray[np.uint8] | str], total: int) -> Iterable[NDArray[np.uint8] | str]:
    return track(frames, "Decoding frames, once", total=total, transient=True)
