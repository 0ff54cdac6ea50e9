"""A capture's images into the scene's folder: as they are, or as a pinhole would have taken them."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from mambaloc.exif import orientation_of, without_exif
from mambaloc.images import Image, center_cropped
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.undistort.decoding import Decoding, decoding_of
from mambaloc.importing.undistort.fitting import FittedCameras, common_sizes
from mambaloc.runtime.camera_models import Size
from mambaloc.runtime.undistortion import undistorted

IMAGES = "images"
_JPEG_QUALITY = 95
_KEPT_SUFFIXES = (".jpg", ".jpeg", ".png")
_LONGEST_NAME = 80


class Written(NamedTuple):
    """Images in a scene's folder.

    Args:
        capture: of what was written; its cameras are pinholes.
        sizes: (width, height) of each image.
        rules: the rule that each of the others breaks, by file.
        lenses: the cameras by the same names as the capture's, as they took the images.
        decoding: how the images were decoded.
    """

    capture: Capture
    sizes: list[Size]
    rules: dict[str, str]
    lenses: dict[str, Camera]
    decoding: Decoding


def write_images(capture: Capture, folder: Path) -> Written:
    """Write every image that can be decoded and has its camera's shape to ``FOLDER/images/SEQUENCE/NAME``.

    Each has the pixels that its pose means, with 8 bits and without an EXIF orientation. Files are copied byte by byte
    where nothing is to be done: neither this, nor distortion to be removed, nor sizes near each other to be made one.

    Raises:
        InputError: where a camera's distortion is that of no lens.
    """
    cameras, decoding = FittedCameras(capture.cameras), decoding_of(capture)
    targets = [folder / IMAGES / name for name in _names(capture)]
    for parent in {target.parent for target in targets}:
        parent.mkdir(parents=True, exist_ok=True)

    def write(row: int, crop: Size | None = None) -> tuple[Size, bool] | str:
        name = None if capture.camera_of is None else capture.camera_of[row]
        return _write(capture.images[row], targets[row], decoding, cameras, name, crop)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = pool.map(write, range(len(targets)))
        written = list(track(results, "Writing images", len(targets), console=Console(stderr=True), transient=True))
        done = {row: each for row, each in enumerate(written) if not isinstance(each, str)}
        taken = {row: size for row, (size, _) in done.items()}
        common = common_sizes(taken.values())
        odd = [row for row, size in taken.items() if size != common[size]]
        list(pool.map(write, odd, [common[taken[row]] for row in odd]))
    rules = {str(capture.images[row]): rule for row, rule in enumerate(written) if isinstance(rule, str)}
    kept = selected(capture, list(taken))
    decoding = decoding.decided({capture.images[row]: is_upright for row, (_, is_upright) in done.items()})
    names, pinholes, lenses = cameras.as_used(kept.camera_of, list(taken.values()), common)
    size_choices = _size_choices(capture.cameras, lenses, len(odd), len(taken))
    images, choices = tuple(targets[row] for row in taken), {**capture.choices, **decoding.choices(), **size_choices}
    kept = replace(kept, images=images, cameras=pinholes, camera_of=names, choices=choices)
    return Written(kept, [common[size] for size in taken.values()], rules, lenses, decoding)


def _size_choices(given: Mapping[str, Camera], lenses: Mapping[str, Camera], odd: int, count: int) -> dict[str, str]:
    """What was decided of images whose size is not their camera's, or not the others'."""
    found, known = ({(each.width, each.height) for each in cameras.values()} for cameras in (lenses, given))
    choices = {}
    if sizes := sorted(found - known):
        named = ", ".join(map(_times, sizes[:3]))
        choices["scaled cameras"] = f"to images of the same shape and another size than the capture says ({named})"
    if odd:
        choices["cropped"] = f"{odd} of {count} images to the middle, so that sizes near each other are one"
    return choices


def selected(capture: Capture, rows: Sequence[int]) -> Capture:
    """Some frames of a capture, in that order."""

    def of(values: tuple[str, ...] | None) -> tuple[str, ...] | None:
        return None if values is None else tuple(values[row] for row in rows)

    depth = capture.depth
    if depth is not None:
        confidence = tuple(depth.confidence[row] for row in rows) if depth.confidence else ()
        depth = replace(depth, files=tuple(depth.files[row] for row in rows), confidence=confidence)
    return replace(
        capture,
        images=tuple(capture.images[row] for row in rows),
        sequences=tuple(capture.sequences[row] for row in rows),
        world_from_cam=capture.world_from_cam[np.array(rows, dtype=np.int64)],
        camera_of=of(capture.camera_of),
        time_s=None if capture.time_s is None else capture.time_s[np.array(rows, dtype=np.int64)],
        split=of(capture.split),
        depth=depth,
        tracks=capture.tracks and capture.tracks.of_frames(np.array(rows, dtype=np.int64)),
    )


def _write(
    source: Path, target: Path, decoding: Decoding, cameras: FittedCameras, name: str | None, crop: Size | None
) -> tuple[Size, bool] | str:
    """Write an image, or the middle of it: its (width, height) and whether it is upright, or the rule it breaks."""
    try:
        data = source.read_bytes()
    except OSError:
        return "image cannot be read"
    first, *others = decoding.ways(data)
    if isinstance(first, str):
        return first
    image, maps = first, None
    if name is not None:
        own = cameras.size(name)
        # A camera's size may tell that a pose means an image the other way round.
        ways = [first] if _size(first) == own else [first, *others]
        fits = [(way, cameras.fitted(name, _size(way))) for way in ways if not isinstance(way, str)]
        image, fit = max(fits, key=lambda fit: (_size(fit[0]) == own, fit[1] is not None))
        if fit is None:
            return f"image is {_times(_size(image))}, of another shape than its camera's {_times(own)}"
        maps = fit[1]
    is_upright = decoding.upright == (image is first)
    if maps is None and crop is None and (copy := _untagged(data, is_upright)) and target.suffix in _KEPT_SUFFIXES:
        target.write_bytes(copy)
        return _size(image), is_upright
    if maps is not None:
        image = undistorted(image, maps)
    if crop is not None:
        image = center_cropped(image, crop[::-1])
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if target.suffix != ".png" else []
    target.write_bytes(cv2.imencode(target.suffix, image[..., ::-1], options)[1].tobytes())
    return _size(image), is_upright


def _untagged(data: bytes, is_upright: bool) -> bytes | None:
    """The file of a JPEG or PNG of 8 bits without its orientation, its pixels as stored; None where it is another."""
    is_jpeg, is_png = data.startswith(b"\xff\xd8"), data.startswith(b"\x89PNG") and data[24] <= 8
    if orientation_of(data) == 1:
        return data if is_jpeg or is_png else None
    return without_exif(data) if is_jpeg and not is_upright else None


def _size(image: Image) -> Size:
    return image.shape[1], image.shape[0]


def _times(size: Size) -> str:
    return f"{size[0]}x{size[1]}"


def _names(capture: Capture) -> list[str]:
    """A path for each image: its own name in a folder of its sequence's, each made safe and unique."""
    folders: dict[str, str] = {}
    for sequence in dict.fromkeys(capture.sequences):
        folders[sequence] = _free(_plain(sequence) or "sequence", "", set(folders.values()))
    taken: dict[str, set[str]] = {folder: set() for folder in folders.values()}
    names = []
    for path, sequence in zip(capture.images, capture.sequences, strict=True):
        folder, suffix = folders[sequence], path.suffix.lower()
        name = _free(_plain(path.stem) or "image", suffix if suffix in _KEPT_SUFFIXES else ".png", taken[folder])
        taken[folder].add(name)
        names.append(f"{folder}/{name}")
    return names


def _plain(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name).strip("._-").lower()[:_LONGEST_NAME]


def _free(stem: str, suffix: str, taken: set[str]) -> str:
    name, number = f"{stem}{suffix}", len(taken)
    while name in taken:
        name, number = f"{stem}-{number}{suffix}", number + 1
    return name
