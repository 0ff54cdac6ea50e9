"""Text of any usual encoding, and names in the order that people count in."""

from __future__ import annotations

import codecs
import re
from decimal import Decimal
from pathlib import Path, PurePath
from typing import TextIO

_MARKS = (  # a mark of UTF-32 begins like one of UTF-16
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
    (codecs.BOM_UTF8, "utf-8-sig"),
)
_HEAD_BYTES = 4096
_STAMP = re.compile(r"([0-9]{6,}\.[0-9]+)(\.[^.0-9][^.]*)?")

Key = tuple[tuple[int, str, int, str], ...]


def encoding_of(data: bytes) -> str:
    """Python's name of a text's encoding, from its bytes or the first ones.

    A byte order mark says it. Without one, text is UTF-8; UTF-16 where every other byte is zero, as in English text; or
    else Windows-1252, which editors on Windows still write.
    """
    for mark, name in _MARKS:
        if data.startswith(mark):
            return name
    zeros = [data[start:_HEAD_BYTES:2].count(0) for start in (0, 1)]
    if max(zeros) > 0.4 * min(len(data), _HEAD_BYTES) / 2 and min(zeros) == 0:
        return "utf-16-be" if zeros[0] else "utf-16-le"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(data)  # the last character may be cut off
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def decode_text(data: bytes) -> str:
    r"""Decode a text of any usual encoding; lines end in ``\n``, and what cannot be decoded becomes U+FFFD."""
    return data.decode(encoding_of(data), errors="replace").replace("\r\n", "\n").replace("\r", "\n")


def open_text(path: Path, newline: str | None = None, errors: str = "replace") -> TextIO:
    """Open a text file of any usual encoding, found by its first bytes, to read it line by line.

    Args:
        path: the file.
        newline: as of :func:`open`.
        errors: how bytes are handled that cannot be decoded, as :func:`open` takes it.

    Raises:
        OSError: where it cannot be read.
    """
    with path.open("rb") as file:
        encoding = encoding_of(file.read(_HEAD_BYTES))
    return path.open(encoding=encoding, errors=errors, newline=newline)


def natural(path: PurePath) -> Key:
    """Key to sort files as people do: ``2.jpg`` before ``10.jpg``, whatever zeros lead.

    A name that is a time stamp such as ``1305031102.5.png`` sorts by its value: digits after its point do not count as
    another number.
    """
    name = path.as_posix()
    if stamp := _STAMP.fullmatch(path.name):
        parent = name.removesuffix(path.name)
        whole, _, fraction = f"{Decimal(stamp[1]):f}".partition(".")
        return (*_words(parent + whole), (2, fraction.rstrip("0"), 0, ""), (0, name, 0, ""))
    return (*_words(name), (0, name, 0, ""))  # the name itself tells 1.jpg and 01.jpg apart


def _words(name: str) -> Key:
    """Words and numbers in turn; digits by their count, then one by one: Python makes no int of more than 4300."""
    words = re.split(r"([0-9]+)", name)
    numbers = [word.lstrip("0") for word in words]
    return tuple(
        (1, "", len(number), number) if place % 2 else (0, word, 0, "")
        for place, (word, number) in enumerate(zip(words, numbers, strict=True))
    )
