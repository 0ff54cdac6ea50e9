"""How a capture's images are decoded: which pixels their poses mean, and which counts of 16 bits are black and white.

Phones store pixels as the sensor has them, and an EXIF orientation says how to turn them. Whether a pose is that of the
stored or of the upright image is a property of what made it: COLMAP ignores the orientation on purpose
(github.com/colmap/colmap, issue 1456), and so do nerfstudio (issue 1260 and pull request 1261 there) and instant-ngp,
whose images stb_image decodes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.exif import head_of, is_tiff, orientation_of
from mambaloc.images import Counts, Image, counts_between, decode_image, decode_pixels, histogram_of
from mambaloc.importing.capture import Capture

_KNOWN = {
    "colmap": "COLMAP",
    "structure_from_motion": "COLMAP",
    "nerfstudio": "nerfstudio and instant-ngp",
    "record3d": "ARKit",
    "polycam": "ARKit",
}
"""Formats whose poses are known to mean stored pixels, and what reads these so."""

_SIDEWAYS = 5  # the first orientation that swaps width and height
_ASKED = 5
_SAMPLED = 100


@dataclass(frozen=True)
class Decoding:
    """What holds for all images of a capture.

    Args:
        kind: the capture's format.
        upright: poses mean upright pixels; otherwise those that the files hold. A camera's size may say otherwise of
            its own images.
        count: how many images there are.
        counts: black and white of 16-bit images; None without any.
        turned: images with an EXIF orientation that were turned upright.
        stored: images with one that were taken as stored.
    """

    kind: str
    upright: bool = False
    count: int = 0
    counts: Counts | None = None
    turned: tuple[Path, ...] = ()
    stored: tuple[Path, ...] = ()

    def ways(self, data: bytes) -> Iterator[Image | str]:
        """A file's image as its pose most likely means it, and then the other way round, where there is one."""
        yield decode_image(data, self.upright, self.counts)
        if orientation_of(data) >= _SIDEWAYS:
            yield decode_image(data, not self.upright, self.counts)

    def decided(self, is_upright: Mapping[Path, bool]) -> Decoding:
        """The same, with how images were taken in the end."""
        of = {path: is_upright.get(path, self.upright) for path in (*self.turned, *self.stored)}
        turned, stored = (tuple(path for path, is_ in of.items() if is_ == wanted) for wanted in (True, False))
        return replace(self, turned=turned, stored=stored)

    def choices(self) -> dict[str, str]:
        """What was decided, by name."""
        notes = []
        if self.turned:
            notes.append(f"upright, as the cameras' sizes say: {self._some(self.turned)} were turned")
        if self.stored:
            why = f"as {self.known} reads them" if self.known else "taken so: the format does not say"
            notes.append(f"as stored, {why}; {self._some(self.stored)} have an EXIF orientation, dropped")
        return {"pixels": "; ".join(notes) or "as stored; no image has an EXIF orientation", **choices_of(self.counts)}

    def _some(self, paths: Sequence[Path]) -> str:
        return f"{len(paths)} of {self.count} images (such as {paths[0].name})"

    @property
    def known(self) -> str | None:
        """What reads images of this format as stored, where that is known."""
        return _KNOWN.get(self.kind)


def choices_of(counts: Counts | None) -> dict[str, str]:
    """What was decided of 16-bit images, by name; empty without any."""
    if counts is None:
        return {}
    black, white = counts
    rule = (
        f"counts {black} to {white} are black to white in all images, which hold 8 bits now; images to localize "
        f"need the same: localize.py --counts {black},{white}"
    )
    return {"16 bits": rule}


def decoding_of(capture: Capture) -> Decoding:
    """Find out how to decode a capture's images from their first bytes, and from a few whole images."""
    images = capture.images
    with ThreadPoolExecutor() as pool:
        heads = list(pool.map(_orientation_and_depth, images))
    oriented = [row for row, (orientation, _) in enumerate(heads) if orientation != 1]
    deep = [image for image, (_, is_deep) in zip(images, heads, strict=True) if is_deep]
    sideways = [row for row in oriented if heads[row][0] >= _SIDEWAYS]
    upright, paths = _are_upright(capture, sideways), tuple(images[row] for row in oriented)
    turned, stored = (paths, ()) if upright else ((), paths)
    return Decoding(capture.kind, upright, len(images), counts_of(deep), turned, stored)


def counts_of(paths: Sequence[Path]) -> Counts | None:
    """Black and white of 16-bit images, the same for all: what all but a few of their pixels lie between.

    Args:
        paths: of images, others among them perhaps; of many, some are read.

    Returns:
        All 16 bits where the images use them; None where there is no 16-bit image.
    """
    rows = np.unique(np.linspace(0, len(paths) - 1, min(_SAMPLED, len(paths))).round().astype(int)).tolist()
    with ThreadPoolExecutor() as pool:
        found = (each for each in pool.map(_histogram, (paths[row] for row in rows)) if each is not None)
        total: NDArray[np.int64] = sum(found, histogram_of(np.zeros(0, np.int64)))
    return counts_between(total) if total.any() else None


def _orientation_and_depth(path: Path) -> tuple[int, bool]:
    """An image's EXIF orientation, and whether it may have 16 bits; of one that cannot be read, neither."""
    head = head_of(path)
    return orientation_of(head), is_tiff(head) or (head.startswith(b"\x89PNG") and head[24:25] == b"\x10")


def _are_upright(capture: Capture, sideways: Sequence[int]) -> bool:
    """Whether cameras are shaped as upright images, where these are not shaped as stored ones."""
    votes: list[bool] = []
    for row in sideways:
        if capture.camera_of is None or len(votes) == _ASKED:
            break
        stored = decode_image(_bytes(capture.images[row]), upright=False)
        camera = capture.cameras[capture.camera_of[row]]
        if not isinstance(stored, str) and stored.shape[0] != stored.shape[1] and camera.width != camera.height:
            votes.append((stored.shape[1] > stored.shape[0]) != (camera.width > camera.height))
    return bool(votes) and all(votes)


def _histogram(path: Path) -> NDArray[np.int64] | None:
    _, may_be_deep = _orientation_and_depth(path)
    pixels: NDArray[Any] | None = decode_pixels(_bytes(path)) if may_be_deep else None
    if pixels is None or pixels.dtype != np.uint16:
        return None
    return histogram_of(pixels)


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""
