"""Image files to arrays, and what a network's input has been through: decoding, resizing, cropping.

Training and the torch-free runtime both use these, so that an image looks the same to either.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.exif import is_tiff, orientation_of, turned, turned_back
from mambaloc.text import natural

Image = NDArray[np.uint8]
"""RGB, (H, W, 3)."""

Counts = tuple[int, int]
"""What a 16-bit image has where 8 bits are black, and where they are white."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff", ".heic", ".heif")
"""Suffixes of files that are taken for images."""

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in grey: ITU-R BT.601, as torchvision and PIL have them."""

LARGEST_SIDE_PX = 32_766
"""Longest side of an image, and of cameras: ``cv2.remap``, which removes distortion, takes no longer one."""

CORNER_PX = 0.5
"""Column and row of the top-left pixel's centre where others count from its corner; here the centre is (0, 0)."""

END_BYTES = 4096
"""How far from a file's end its format's last marker may lie."""

FULL_COUNTS: Counts = (0, 65535)
"""Of an image that uses the whole of its 16 bits, as photos do."""

_STRAYS = 0.001  # of all pixels, at either end

_AS_STORED = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
_MARKERS = {b"\x89PNG": b"IEND", b"\xff\xd8\xff": b"\xff\xd9"}  # how a format starts, and how a whole file ends
_STARTS = (*_MARKERS, b"BM", b"II*\0", b"MM\0*")
_HEIF = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"mif2", b"msf1")
_AVIF = (b"avif", b"avis")


def list_images(folder: Path) -> list[Path]:
    """The images in a folder in natural order, without depth; none where there is no such folder.

    Raises:
        InputError: where it may not be read.
    """
    return sorted(_images(folder), key=natural)


def has_images(folder: Path) -> bool:
    """Whether :func:`list_images` finds any; it raises the same."""
    return bool(_images(folder))


def _images(folder: Path) -> list[Path]:
    try:
        files = list(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror}); make it readable") from None
    return [p for p in files if p.suffix.lower() in IMAGE_SUFFIXES and ".depth." not in p.name]


def is_image(path: Path) -> bool:
    """Whether a file is a still image, by its name or its first bytes."""
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return True
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError:
        return False
    return head.startswith(_STARTS) or head[8:12] == b"WEBP" or _brand(head) in _HEIF + _AVIF


def decode_image(data: bytes, upright: bool = True, counts: Counts | None = None) -> Image | str:
    """Decode a file's bytes to RGB; or return the rule that it breaks.

    Grey becomes RGB, and an alpha channel is dropped.

    Args:
        data: of the file.
        upright: turn it as its EXIF orientation says; otherwise pixels are those that the file holds.
        counts: black and white of a 16-bit image; unless given, only one that uses all its 16 bits is decoded.
    """
    if (brand := _brand(data)) in _HEIF + _AVIF:
        return _decode_heif(data) if brand in _HEIF else "image is AVIF. Export it as JPEG."
    for start, end in _MARKERS.items():
        # OpenCV fills what a truncated file lacks with grey and says nothing.
        if data.startswith(start) and end not in data[-END_BYTES:]:
            return "image is truncated"
    pixels = decode_pixels(data)
    if pixels is None:
        return "image cannot be decoded"
    if pixels.dtype == np.uint16:
        if counts is None and counts_between(histogram_of(pixels)) != FULL_COUNTS:
            return (
                f"image has 16 bits and only counts from {pixels.min()} to {pixels.max()}. Say which counts are black "
                "and white: import_scene.py finds them, localize.py takes --counts."
            )
        pixels = stretched(pixels, counts or FULL_COUNTS)
    if pixels.dtype != np.uint8:
        return f"image has {pixels.dtype} numbers. Export it with 8 or 16 bits."
    if is_tiff(data):  # which OpenCV turns upright even where it is asked not to
        return pixels if upright else turned_back(pixels, orientation_of(data))
    return turned(pixels, orientation_of(data)) if upright else pixels


def decode_pixels(data: bytes) -> NDArray[Any] | None:
    """Decode a file's bytes to RGB (H, W, 3) of the file's own depth; None where they cannot be."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), _AS_STORED) if data else None
    except cv2.error:  # a damaged header that asks for more than 2^30 pixels
        return None


def counts_between(histogram: NDArray[np.int64]) -> Counts:
    """Black and white of 16-bit images: what all but a few pixels lie between, or all 16 bits where that is most.

    Args:
        histogram: how many pixels have each of 65536 counts; not none.
    """
    share = np.cumsum(histogram) / histogram.sum()
    black, white = np.searchsorted(share, (_STRAYS, 1 - _STRAYS)).tolist()
    # Photographs use all 16 bits, and their 8 bits are the upper ones; thermal cameras use few.
    return FULL_COUNTS if white - black > FULL_COUNTS[1] // 2 else (black, max(white, black + 1))


def histogram_of(pixels: NDArray[Any]) -> NDArray[np.int64]:
    """How many pixels, of all channels, have each of 65536 counts."""
    return np.bincount(pixels.ravel(), minlength=FULL_COUNTS[1] + 1)


def stretched(pixels: NDArray[Any], counts: Counts) -> Image:
    """Eight bits of 16, from black to white; counts beyond are cut off."""
    black, white = counts
    grey = (np.arange(FULL_COUNTS[1] + 1) - black) * 255 / (white - black)
    return grey.round().clip(0, 255).astype(np.uint8)[pixels]


def _brand(data: bytes) -> bytes:
    return data[8:12] if data[4:8] == b"ftyp" else b""


def _decode_heif(data: bytes) -> Image | str:
    """Decode the image of a phone's HEIC, which says how to turn it by itself, with or without EXIF."""
    try:
        import pillow_heif  # only here: an extra
    except ImportError:
        return "image is HEIC, and pillow-heif is missing. Run pip install 'mambaloc[heic]', or export it as JPEG."
    try:
        return as_rgb(np.asarray(pillow_heif.open_heif(data)))
    except (ValueError, OSError, RuntimeError, EOFError, SyntaxError):
        return "image cannot be decoded"


def read_image(path: str | Path, counts: Counts | None = None) -> Image:
    """Read an image file as RGB, upright.

    Args:
        path: the file.
        counts: as :func:`decode_image` takes them.

    Raises:
        InputError: if it is missing, truncated or not an image, or has 16 bits and does not use them.
    """
    return _read(path, True, counts)


def _read(path: str | Path, upright: bool, counts: Counts | None) -> Image:
    try:
        image = decode_image(Path(path).read_bytes(), upright, counts)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give an image") from None
    if isinstance(image, str):
        raise InputError(f"{path}: {image}" if image.endswith(".") else f"{path}: {image}; give a whole JPEG or PNG")
    return image


def stored_size(path: str | Path) -> tuple[int, int]:
    """(width, height) of an image as its file stores it, which is what a camera's intrinsics are of.

    Raises:
        InputError: as :func:`read_image`, but not for what its 16 bits hold.
    """
    height, width = _read(path, False, FULL_COUNTS).shape[:2]
    return width, height


def as_rgb(image: Image) -> Image:
    """Check an array and make grey or RGBA RGB; (H, W), (H, W, 3) or (H, W, 4) -> (H, W, 3).

    Raises:
        InputError: for anything else.
    """
    image = np.asarray(image)
    channels = {2: 1, 3: image.shape[-1]}.get(image.ndim)
    if image.dtype != np.uint8 or channels not in (1, 3, 4) or 0 in image.shape:
        raise InputError(f"image array {image.dtype} {image.shape}: give uint8 RGB (H, W, 3) or grey (H, W)")
    if image.ndim == 2:
        image = image[..., None]
    return np.repeat(image, 3, axis=-1) if channels == 1 else image[..., :3]


def resized_size(size: tuple[int, int], short_side: int) -> tuple[int, int]:
    """(height, width) of an image once its shorter side has so many pixels."""
    scale = short_side / min(size)
    return round(size[0] * scale), round(size[1] * scale)


def resized(image: Image, short_side: int) -> Image:
    """Resize so that the shorter side has so many pixels, averaging areas where that is smaller."""
    height, width = resized_size(image.shape[:2], short_side)
    how = cv2.INTER_AREA if height < image.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=how)  # type: ignore[return-value]


def center_corner(size: Sequence[int], crop: tuple[int, int]) -> tuple[int, int]:
    """(row, column) of the top-left pixel of the middle crop, both sizes (height, width)."""
    return (size[0] - crop[0]) // 2, (size[1] - crop[1]) // 2


def center_cropped(image: Image, crop: tuple[int, int]) -> Image:
    """Take the middle (height, width) of an image, black where the image is smaller."""
    top, left = center_corner(image.shape[:2], crop)
    inside = image[max(top, 0) : top + crop[0], max(left, 0) : left + crop[1]]
    if inside.shape[:2] == crop:
        return inside
    cropped = np.zeros((*crop, *image.shape[2:]), image.dtype)
    cropped[max(-top, 0) :, max(-left, 0) :][: inside.shape[0], : inside.shape[1]] = inside
    return cropped
