"""Text, JSON, numbers and file names of an untrusted source: checked, or refused with a one-line ``InputError``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.files import path_inside, read_json
from mambaloc.images import IMAGE_SUFFIXES, has_images, list_images
from mambaloc.text import decode_text

_MAX_BYTES = 1 << 26  # of a text: poses of a million images


@dataclass(frozen=True)
class Table:
    """Rows of numbers, and where each was read.

    Args:
        path: the file.
        lines: N line numbers, from 1.
        words: the first word of each.
        numbers: (N, columns) float64.
    """

    path: Path
    lines: tuple[int, ...]
    words: tuple[str, ...]
    numbers: NDArray[np.float64]

    def where(self, row: int) -> str:
        """Name a row, for a message."""
        return f"{self.path}, line {self.lines[row]}"


def read_text(path: Path, holds: str) -> str:
    """Read a text file.

    Args:
        path: the file.
        holds: what should be in it, for messages.

    Raises:
        InputError: where it is missing, cannot be read, or is too large to be one.
    """
    try:
        if not path.is_file():
            raise InputError(f"{path}: missing; it holds {holds}")
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(f"{path}: is larger than {_MAX_BYTES >> 20} MiB; give a text that holds {holds}")
        return decode_text(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); it holds {holds}") from None


def read_lines(path: Path, holds: str) -> list[tuple[int, list[str]]]:
    """The words of each line with its number, without blank lines and ``#`` comments; as :func:`read_text`."""
    lines = enumerate(read_text(path, holds).splitlines(), start=1)
    return [(number, line.split()) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]


def read_table(path: Path, columns: int, row: str, named: bool = False, may_lack_fix: bool = False) -> Table:
    """Read lines of so many finite numbers each.

    Args:
        path: the file.
        columns: numbers in a line.
        row: what a line is, for messages.
        named: whether a word comes before the numbers.
        may_lack_fix: whether NaN and infinity are kept, which mark a pose without a fix.

    Raises:
        InputError: where it cannot be read, contains no line, or one of its lines is anything else.
    """
    lines = read_lines(path, f"a line each: {row}")
    numbers = np.empty((len(lines), columns))
    for at, (line, words) in enumerate(lines):
        values = as_numbers(words[int(named) :])
        if values is None or len(values) != columns or not (may_lack_fix or np.isfinite(values).all()):
            raise InputError(f"{path}, line {line}: is not a line {row!r} of finite numbers; correct or remove it")
        numbers[at] = values
    if not lines:
        raise InputError(f"{path}: is empty; it holds a line each: {row}")
    return Table(path, tuple(line for line, _ in lines), tuple(words[0] for _, words in lines), numbers)


def as_numbers(words: Sequence[str]) -> NDArray[np.float64] | None:
    """Numbers from words, not all finite perhaps; None if a word is not a number."""
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        return None


def read_object(path: Path, holds: str) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        InputError: where it cannot be read, or is of another format.
    """
    value = read_json(path, f"it holds {holds}", f"it holds {holds}, export it again")
    if not isinstance(value, dict):
        raise InputError(f"{path}: is not a JSON object; it holds {holds}, export it again")
    return value


def read_xml(path: Path, holds: str) -> ElementTree.Element:
    """Read the root of an XML file; one that declares a document type, as entities need, is refused unread.

    Raises:
        InputError: where it cannot be read, or is of another format.
    """
    text = read_text(path, holds)

    def refuse(*_: object) -> None:
        raise InputError(f"{path}: declares a document type, which may hold entities; remove <!DOCTYPE ...>")

    guard = expat.ParserCreate()
    guard.StartDoctypeDeclHandler = refuse
    try:
        guard.Parse(text, True)
        return ElementTree.fromstring(text)
    except (expat.ExpatError, ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: is not XML ({error}); it holds {holds}, export it again") from None


def array_of(
    value: Any, shape: tuple[int | None, ...], name: str, path: Path, may_lack_fix: bool = False
) -> NDArray[np.float64]:
    """Finite numbers of a JSON value.

    Args:
        value: lists of numbers, or a number.
        shape: what they must come in; None is any length.
        name: of the value, for messages.
        path: the file, for messages.
        may_lack_fix: as of :func:`read_table`.

    Raises:
        InputError: for anything else.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # no numbers, ragged, or larger than a float
        array = np.array(np.nan)
    fits = array.ndim == len(shape) and all(want in (None, is_) for want, is_ in zip(shape, array.shape, strict=True))
    if not fits or not (may_lack_fix or np.isfinite(array).all()):
        size = " x ".join("N" if length is None else str(length) for length in shape) or "one"
        raise InputError(f"{path}: {name!r} must be {size} finite numbers; export it again")
    return array


def inside(folder: Path, name: Any, where: str) -> Path:
    """The path of a file that a source names by its place in a folder; whether it is there is not asked.

    Args:
        folder: of the source.
        name: relative path, with either kind of slash; in JSON it may be anything.
        where: what names it, for messages.

    Raises:
        InputError: for a name that leads out of the folder, or is not a valid file name.
    """
    path = path_inside(folder, name) if isinstance(name, str) else None
    if path is None:
        raise InputError(f"{where}: names {str(name)[:60]!r}, which is not a file inside {folder}; correct the name")
    return path


def images_in_same_folders(images: Iterable[Path]) -> list[Path]:
    """All images in the folders that images are in, as :func:`list_images`."""
    return [sibling for folder in dict.fromkeys(image.parent for image in images) for sibling in list_images(folder)]


def first_with_images(folders: Sequence[Path]) -> Path:
    """The first of some folders that holds images.

    Raises:
        InputError: where none does.
    """
    for folder in folders:
        if has_images(folder):
            return folder
    names = ", ".join(str(folder) for folder in folders)
    raise InputError(f"{names}: no folder contains an image ({', '.join(IMAGE_SUFFIXES)}). Put the images there.")


def only_file(found: Iterable[Path], source: Path) -> Path:
    """The one file of a format that was found at a source; the source itself where none was.

    Raises:
        InputError: where there are several.
    """
    files = list(found) or [source]
    if len(files) > 1:
        raise InputError(f"{source}: holds {' and '.join(each.name for each in files)}; give the one to read")
    return files[0]


def folder_name(folder: Path) -> str:
    """What a folder is called, also where it is given as ``.``."""
    return folder.resolve().name or "recording"


def number_of(path: Path) -> int:
    """The number that a file is named by, as 12 of ``frame000012.jpg``; -1 where it has none, or several."""
    numbers = re.findall(r"[0-9]+", path.stem)
    return int(numbers[0]) if len(numbers) == 1 else -1
