"""Which way round an image is stored: the orientation tag of its EXIF, read, applied and taken out.

Values are those of tag 0x0112 in EXIF 2.32: 1 is upright, and of 2 to 8 each is another mirror or turn of the pixels.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[Any]

_JPEG, _PNG, _TIFF = b"\xff\xd8", b"\x89PNG\r\n\x1a\n", (b"II*\0", b"MM\0*")
_EXIF = b"Exif\0\0"
_APP1, _SCAN, _END = 0xE1, 0xDA, 0xD9  # of a JPEG; EXIF and XMP are in APP1, and pixels follow the scan's head
_ORIENTATION, _SHORT = 0x0112, 3
_MAX_ENTRIES = 1000
_HEAD_BYTES = 1 << 17  # a JPEG's EXIF has at most half of it

_TURNS: dict[int, Callable[[Pixels], Pixels]] = {
    2: np.fliplr,
    3: lambda stored: np.rot90(stored, 2),
    4: np.flipud,
    5: lambda stored: np.swapaxes(stored, 0, 1),
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: np.rot90(np.swapaxes(stored, 0, 1), 2),
    8: np.rot90,
}
_BACK = {6: 8, 8: 6}  # the others undo themselves


def orientation_of(data: bytes) -> int:
    """The orientation, 1 to 8, of a JPEG, PNG, WebP or TIFF file's bytes; 1 by default."""
    if is_tiff(data):
        return _in_tiff(data)
    if data.startswith(_JPEG):
        found = (data[start + 4 : end] for code, start, end in _segments(data) if code == _APP1)
    elif data.startswith(_PNG):
        found = (data[start:end] for name, start, end in _chunks(data, 8, ">I4s", 4) if name == b"eXIf")
    elif data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        found = (data[start:end] for name, start, end in _chunks(data, 12, "<4sI", 0) if name == b"EXIF")
    else:
        return 1
    for exif in found:
        if exif.startswith((_EXIF, *_TIFF)):  # XMP is in APP1, too
            return _in_tiff(exif.removeprefix(_EXIF))
    return 1


def head_of(path: Path) -> bytes:
    """The first bytes of an image's file, which hold its orientation; none where it cannot be read."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
            return head + file.read() if head.startswith(b"RIFF") else head  # a WebP's EXIF is at its end
    except OSError:
        return b""


def unclear_pose(head: bytes) -> str | None:
    """The rule that a posed image breaks where an orientation leaves open which of its pixels the pose means."""
    if (orientation := orientation_of(head)) == 1:
        return None
    return (
        f"image has EXIF orientation {orientation}, so its pose may mean stored or upright pixels. "
        "Write it upright without one, or import the capture again."
    )


def is_tiff(data: bytes) -> bool:
    """Whether a file is a TIFF, or a camera's raw file, which is built as one."""
    return data.startswith(_TIFF)


def turned(stored: Pixels, orientation: int) -> Pixels:
    """Turn stored pixels (H, W, ...) upright."""
    return np.ascontiguousarray(_TURNS[orientation](stored)) if orientation in _TURNS else stored


def turned_back(upright: Pixels, orientation: int) -> Pixels:
    """Turn upright pixels (H, W, ...) as a file of that orientation stores them."""
    return turned(upright, _BACK.get(orientation, orientation))


def without_exif(jpeg: bytes) -> bytes:
    """A JPEG without its EXIF and XMP, each of which may hold an orientation; no pixel changes."""
    kept, at = [], 0
    for code, start, end in _segments(jpeg):
        if code == _APP1:
            kept.append(jpeg[at:start])
            at = end
    return b"".join((*kept, jpeg[at:]))


def _segments(jpeg: bytes) -> Iterator[tuple[int, int, int]]:
    """Code, start and end of each segment before the pixels, with its marker."""
    at = 2
    while at + 4 <= len(jpeg) and jpeg[at] == 0xFF:
        if jpeg[at + 1] == 0xFF:  # markers may be padded
            at += 1
            continue
        if jpeg[at + 1] in (_SCAN, _END):
            return
        end = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        yield jpeg[at + 1], at, end
        at = end


def _chunks(data: bytes, at: int, head: str, after: int) -> Iterator[tuple[bytes, int, int]]:
    """Name, start and end of each chunk's content in a PNG (length first) or a WebP (name first, even lengths)."""
    while at + 8 <= len(data):
        first, second = struct.unpack_from(head, data, at)
        name, length = (second, first) if isinstance(first, int) else (first, second)
        yield name, at + 8, at + 8 + length
        at += 8 + length + after + (0 if after else length % 2)


def _in_tiff(tiff: bytes) -> int:
    order = "<" if tiff.startswith(b"II") else ">"
    try:
        (at,) = struct.unpack_from(f"{order}I", tiff, 4)
        (entries,) = struct.unpack_from(f"{order}H", tiff, at)
        for entry in range(min(entries, _MAX_ENTRIES)):
            tag, kind, count, value = struct.unpack_from(f"{order}HHIH", tiff, at + 2 + 12 * entry)
            if (tag, kind, count) == (_ORIENTATION, _SHORT, 1):
                return value if 1 <= value <= 8 else 1
    except struct.error:  # cut off, or no EXIF
        pass
    return 1
