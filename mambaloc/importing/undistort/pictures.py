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

from mambaloc.images import Image, center_cropped, decode_image
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.undistort.fitting import FittedCameras, Size, common_sizes

IMAGES = "images"
_JPEG_QUALITY = 95
_KEPT_SUFFIXES = (".jpg", ".jpeg", ".png")
_LONGEST_NAME = 80


class Written(NamedTuple):
    """Pictures in a scene's folder.

    Args:
        capture: of what was written; its cameras are pinholes.
        sizes: (width, height) of each image.
        rules: the rule that each of the others breaks, by file.
        lenses: the cameras by the same names as the capture's, as they took the pictures.
    """

    capture: Capture
    sizes: list[Size]
    rules: dict[str, str]
    lenses: dict[str, Camera]


def write_pictures(capture: Capture, folder: Path) -> Written:
    """Write every image that can be decoded and has its camera's shape to ``FOLDER/images/SEQUENCE/NAME``.

    Files are copied byte by byte, unless they lie on their side, distortion is removed from them, or sizes that are
    near each other are cropped to one.

    Raises:
        InputError: where a camera's distortion is that of no lens.
    """
    cameras = FittedCameras(capture.cameras)
    targets = [folder / IMAGES / name for name in _names(capture)]
    for parent in {target.parent for target in targets}:
        parent.mkdir(parents=True, exist_ok=True)

    def write(row: int, crop: Size | None = None) -> Size | str:
        name = None if capture.camera_of is None else capture.camera_of[row]
        return _write(capture.images[row], targets[row], cameras, name, crop)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = pool.map(write, range(len(targets)))
        written = list(track(results, "Writing images", len(targets), console=Console(stderr=True), transient=True))
        taken = {row: size for row, size in enumerate(written) if not isinstance(size, str)}
        common = common_sizes(taken.values())
        odd = [row for row, size in taken.items() if size != common[size]]
        list(pool.map(write, odd, [common[taken[row]] for row in odd]))
    rules = {str(capture.images[row]): rule for row, rule in enumerate(written) if isinstance(rule, str)}
    kept = selected(capture, list(taken))
    names, pinholes, lenses = cameras.as_used(kept.camera_of, list(taken.values()), common)
    said = _said(capture.cameras, lenses, len(odd), len(taken))
    images, choices = tuple(targets[row] for row in taken), {**capture.choices, **said}
    kept = replace(kept, images=images, cameras=pinholes, camera_of=names, choices=choices)
    return Written(kept, [common[size] for size in taken.values()], rules, lenses)


def _said(told: Mapping[str, Camera], lenses: Mapping[str, Camera], odd: int, count: int) -> dict[str, str]:
    """What was decided of pictures whose size is not their camera's, or not the others'."""
    sizes = {(each.width, each.height) for each in lenses.values()} - {(each.width, each.height) for each in told.values()}
    said = {}
    if sizes:
        named = ", ".join(f"{width}x{height}" for width, height in sorted(sizes)[:3])
        said["scaled cameras"] = f"to pictures of the same shape and another size than the capture says ({named})"
    if odd:
        said["cropped"] = f"{odd} of {count} pictures to the middle, so that sizes near each other are one"
    return said


def selected(capture: Capture, rows: Sequence[int]) -> Capture:
    """Some frames of a capture, in that order."""

    def of(values: tuple[str, ...] | None) -> tuple[str, ...] | None:
        return None if values is None else tuple(values[row] for row in rows)

    depth = capture.depth
    return replace(
        capture,
        images=tuple(capture.images[row] for row in rows),
        sequences=tuple(capture.sequences[row] for row in rows),
        world_from_cam=capture.world_from_cam[np.array(rows, dtype=np.int64)],
        camera_of=of(capture.camera_of),
        time_s=None if capture.time_s is None else capture.time_s[np.array(rows, dtype=np.int64)],
        split=of(capture.split),
        depth=depth and replace(depth, files=tuple(depth.files[row] for row in rows)),
        tracks=capture.tracks and capture.tracks.of_frames(np.array(rows, dtype=np.int64)),
    )


def _write(source: Path, target: Path, cameras: FittedCameras, name: str | None, crop: Size | None) -> Size | str:
    """Write an image, or the middle of it, and return its (width, height), or the rule that it breaks."""
    try:
        data = source.read_bytes()
    except OSError:
        return "image cannot be read"
    image = decode_image(data)
    if isinstance(image, str):
        return image
    is_as_it_is, maps = crop is None, None
    if name is not None:
        own = cameras.size(name)
        # Structure from motion may have ignored the EXIF orientation: the camera's size tells which way round it is.
        ways = [image] if _size(image) == own else [image, decode_image(data, upright=False)]
        fits = [(way, cameras.fitted(name, _size(way))) for way in ways if not isinstance(way, str)]
        best, fit = max(fits, key=lambda fit: (_size(fit[0]) == own, fit[1] is not None))
        if fit is None:
            return f"image is {_times(_size(image))}, of another shape than its camera's {_times(own)}"
        is_as_it_is, image, maps = is_as_it_is and best is image, best, fit[1]
    if maps is not None:
        # The border's last hundredth of a pixel is rounding, and nothing to be black.
        image = cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[assignment]
        is_as_it_is = False
    if crop is not None:
        image = center_cropped(image, crop[::-1])
    if is_as_it_is and source.suffix.lower() in _KEPT_SUFFIXES:
        target.write_bytes(data)
    else:
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if target.suffix != ".png" else []
        target.write_bytes(cv2.imencode(target.suffix, image[..., ::-1], options)[1].tobytes())
    return _size(image)


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
