"""COLMAP's text models as they are found in the wild, in the form that pycolmap reads.

An image has two lines: ``IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME``, and its points ``X Y POINT3D_ID ...``, which
may be empty. pycolmap cuts a name at its first space, takes the second line for granted, so that it skips every other
image of a file without it, and asks for ``points3D``. Source: colmap.github.io/format.html.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TextIO

from mambaloc.errors import InputError
from mambaloc.text import open_text

_IMAGE_LINE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_BEFORE_NAME = 9  # words
_LONGEST_LINE = 1 << 26  # characters: a million points
_TEXTS = ("cameras.txt", "points3D.txt", "rigs.txt", "frames.txt")
_NO_POINTS = {"points3D.txt": b"", "points3D.bin": bytes(8)}


@contextmanager
def readable(path: Path) -> Iterator[tuple[Path, dict[int, str]]]:
    """Give a folder whose model pycolmap reads whole, and the names of its images by their number where it would not.

    Args:
        path: the folder of a model, text or binary.

    Raises:
        InputError: for a file that is missing, no text, or a line that is neither an image nor its points.
    """
    is_binary = (path / "images.bin").is_file()
    cameras, points = (path / f"{name}{'.bin' if is_binary else '.txt'}" for name in ("cameras", "points3D"))
    if not cameras.is_file():
        raise InputError(f"{cameras}: is missing next to {'images.bin' if is_binary else 'images.txt'}; export it, too")
    if is_binary and points.is_file():
        yield path, {}
        return
    with TemporaryDirectory() as name:
        folder = Path(name)
        if is_binary:
            for file in path.glob("*.bin"):
                (folder / file.name).symlink_to(file.resolve())
        else:
            for file in (path / text for text in _TEXTS if (path / text).is_file()):
                with _opened(file) as source, (folder / file.name).open("w", encoding="utf-8") as target:
                    shutil.copyfileobj(source, target)
        if not points.is_file():
            (folder / points.name).write_bytes(_NO_POINTS[points.name])
        yield folder, {} if is_binary else _numbered(path / "images.txt", folder / "images.txt")


def count_images(path: Path) -> int:
    """How many images the model in a folder has; 0 where it cannot be read."""
    try:
        if (path / "images.bin").is_file():
            with (path / "images.bin").open("rb") as file:
                return int.from_bytes(file.read(8), "little")
        return sum(1 for _ in _images(path / "images.txt"))
    except (InputError, OSError):
        return 0


def _numbered(source: Path, target: Path) -> dict[int, str]:
    """Write the images with their numbers for names, two lines each, and return the names by number."""
    names: dict[int, str] = {}
    with target.open("w", encoding="utf-8") as file:
        for number, words, points in _images(source):
            image = int(words[0])
            if image in names:
                raise InputError(f"{source}, line {number}: image number {image} is used twice; change one")
            names[image] = words[_BEFORE_NAME]
            file.write(f"{' '.join(words[:_BEFORE_NAME])} {image}\n{points}\n")
    return names


def _images(path: Path) -> Iterator[tuple[int, list[str], str]]:
    """The number of each image's line, its ten words, and its line of points, empty where it has none."""
    lines = _lines(path)
    number, line = next(lines, (0, ""))
    while number:
        if line and not _is_image(line):
            raise InputError(
                f"{path}, line {number}: is neither an image '{_IMAGE_LINE}' nor points 'X Y POINT3D_ID ...' of "
                "the image "
                "before it. Write two lines an image, the second empty where it has no points."
            )
        following = next(lines, (0, ""))
        if line:
            has_points = not following[1] or _is_points(following[1].split())
            yield number, line.split(maxsplit=_BEFORE_NAME), following[1] if has_points else ""
            following = next(lines, (0, "")) if has_points else following
        number, line = following


def _is_image(line: str) -> bool:
    words = line.split(maxsplit=_BEFORE_NAME)
    is_like = len(words) > _BEFORE_NAME and _is_integer(words[0]) and _is_integer(words[_BEFORE_NAME - 1])
    return is_like and not _is_points(line.split())


def _is_points(words: list[str]) -> bool:
    """Whether a line is one of points, rather than of an image whose name ends in a number."""
    return (
        len(words) % 3 == 0 and all(map(_is_integer, words[2::3])) and all(map(_is_number, words[: 2 * _BEFORE_NAME]))
    )


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_integer(word: str) -> bool:
    return word.isascii() and word.removeprefix("-").isdecimal()


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that are not comments, by their number from 1, without spaces around them."""
    with _opened(path) as file:
        number = 0
        while line := file.readline(_LONGEST_LINE):
            number += 1
            if len(line) == _LONGEST_LINE:
                raise InputError(f"{path}, line {number}: is longer than any image's; export the model again")
            if not line.startswith("#"):
                yield number, line.strip()


def _opened(path: Path) -> TextIO:
    """A text in any usual encoding, with whatever ends of lines."""
    try:
        return open_text(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); export the model again") from None
