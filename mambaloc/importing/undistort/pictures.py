"""A capture's images into the scene's folder: as they are, or as a pinhole would have taken them."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mambaloc.images import Image, decode_image
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.undistort.distortion import pinhole_of, sampled_at

IMAGES = "images"
_JPEG_QUALITY = 95
_KEPT_SUFFIXES = (".jpg", ".jpeg", ".png")
_MAPS_KEPT = 4  # of cameras, at a time: each is as large as a few images
_LONGEST_NAME = 80

Size = tuple[int, int]
Maps = tuple[NDArray[np.float32], NDArray[np.float32]]


def write_pictures(capture: Capture, folder: Path) -> tuple[Capture, list[Size], dict[str, str]]:
    """Write every image that can be decoded and is of its camera's size to ``FOLDER/images/SEQUENCE/NAME``.

    Files are copied byte by byte, unless distortion is removed from them or they lie on their side.

    Returns:
        The capture of what was written, whose cameras are pinholes; (width, height) of each image; and the rule that
        each of the others breaks, by file.

    Raises:
        InputError: where a camera's distortion is that of no lens.
    """
    pinholes = {name: pinhole_of(name, camera) for name, camera in capture.cameras.items()}
    targets = [folder / IMAGES / name for name in _names(capture)]
    for parent in {target.parent for target in targets}:
        parent.mkdir(parents=True, exist_ok=True)
    lock = Lock()  # the first images of a camera all ask for its maps

    @lru_cache(_MAPS_KEPT)
    def maps_of(name: str) -> Maps | None:
        camera = capture.cameras[name]
        return None if camera.distorted is None else sampled_at(camera, pinholes[name])

    def write(row: int) -> Size | str:
        if capture.camera_of is None:
            return _write(capture.images[row], targets[row], None, None)
        name = capture.camera_of[row]
        with lock:
            maps = maps_of(name)
        return _write(capture.images[row], targets[row], capture.cameras[name], maps)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = pool.map(write, range(len(targets)))
        written = list(track(results, "Writing images", len(targets), console=Console(stderr=True), transient=True))
    sizes = {row: size for row, size in enumerate(written) if not isinstance(size, str)}
    rules = {str(capture.images[row]): rule for row, rule in enumerate(written) if isinstance(rule, str)}
    kept = replace(selected(capture, list(sizes)), images=tuple(targets[row] for row in sizes), cameras=pinholes)
    return kept, list(sizes.values()), rules


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


def _write(source: Path, target: Path, camera: Camera | None, maps: Maps | None) -> Size | str:
    """Write an image and return its (width, height), or the rule that it breaks."""
    try:
        data = source.read_bytes()
    except OSError:
        return "image cannot be read"
    image = decode_image(data)
    if isinstance(image, str):
        return image
    is_as_it_is = True
    if camera is not None and _size(image) != (camera.width, camera.height):
        # Structure from motion may have ignored the EXIF orientation: the camera's size tells which way round it is.
        stored = decode_image(data, upright=False)
        if isinstance(stored, str) or _size(stored) != (camera.width, camera.height):
            return f"image is {'x'.join(map(str, _size(image)))}, its camera's {camera.width}x{camera.height}"
        image, is_as_it_is = stored, False
    if maps is not None:
        # The border's last hundredth of a pixel is rounding, and nothing to be black.
        image = cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[assignment]
        is_as_it_is = False
    if is_as_it_is and source.suffix.lower() in _KEPT_SUFFIXES:
        target.write_bytes(data)
    else:
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if target.suffix != ".png" else []
        target.write_bytes(cv2.imencode(target.suffix, image[..., ::-1], options)[1].tobytes())
    return _size(image)


def _size(image: Image) -> Size:
    return image.shape[1], image.shape[0]


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
