"""What an MP4 or QuickTime video says of itself and OpenCV does not pass on: how much of it is shown, and its light.

Boxes of ISO/IEC 14496-12: ``moov/mvhd`` has ticks a second, ``trak/edts/elst`` the parts that are shown, and ``colr``
the colours, whose transfer is 16 for PQ and 18 for HLG (ITU-T H.273).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_MAX_BYTES = 1 << 26  # of moov: tables of hours
_HDR = {16: "PQ", 18: "HLG"}


class About(NamedTuple):
    """What a video says of itself.

    Args:
        shown_s: how long its edit list shows its images; None where it has none.
        hdr: the transfer of a video with a high dynamic range, ``PQ`` or ``HLG``; None for any other.
    """

    shown_s: float | None = None
    hdr: str | None = None


def read_about(path: Path) -> About:
    """Read what a video says of itself; nothing where it is of another format or damaged."""
    try:
        moov = _moov(path)
        ticks_hz = next((_ticks_hz(moov[a:b]) for kind, a, b in _boxes(moov) if kind == b"mvhd"), 0)
        tracks = [moov[a:b] for kind, a, b in _boxes(moov) if kind == b"trak"]
        video_track = next((track for track in tracks if b"vide" in track), b"")
        edits = [_shown_ticks(part[a:b]) for part in _inside(video_track, b"edts") for kind, a, b in _boxes(part)]
        at = video_track.find(b"colrnclx")
        transfer = struct.unpack_from(">H", video_track, at + 10)[0] if at >= 0 else 0
        return About(edits[0] / ticks_hz if edits and edits[0] and ticks_hz else None, _HDR.get(transfer))
    except (OSError, struct.error):
        return About()


def _moov(path: Path) -> bytes:
    """The box of tables, wherever it lies in the file."""
    size = path.stat().st_size
    with path.open("rb") as file:
        at = 0
        while at + 8 <= size:
            file.seek(at)
            head = file.read(16)
            length, kind = struct.unpack_from(">I4s", head)
            skip = 8
            if length == 1:
                (length,), skip = struct.unpack_from(">Q", head, 8), 16
            length = size - at if length == 0 else length
            if kind == b"moov" and length <= _MAX_BYTES:
                file.seek(at + skip)
                return file.read(length - skip)
            if length < 8:
                break
            at += length
    return b""


def _boxes(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of what is in each box."""
    at = 0
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if length < 8:
            return
        yield kind, at + 8, min(at + length, len(data))
        at += length


def _inside(data: bytes, name: bytes) -> list[bytes]:
    return [data[start:end] for kind, start, end in _boxes(data) if kind == name]


def _ticks_hz(mvhd: bytes) -> int:
    return int(struct.unpack_from(">I", mvhd, 20 if mvhd[:1] == b"\1" else 12)[0])


def _shown_ticks(elst: bytes) -> int:
    """The length of all parts of an edit list, less those that show nothing."""
    entry = ">Qqi" if elst[:1] == b"\1" else ">Iii"
    (count,) = struct.unpack_from(">I", elst, 4)
    size = struct.calcsize(entry)
    parts = [struct.unpack_from(entry, elst, 8 + size * row) for row in range(min(count, len(elst) // size))]
    return sum(ticks for ticks, start, _ in parts if start >= 0)
