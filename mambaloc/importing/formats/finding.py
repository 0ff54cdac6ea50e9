"""Where the images are that a source names: by their paths, or by the ends of these below one folder.

Paths are often those of another machine, or of the folder that a tool was called in. Nothing outside of the folder is
looked at, and the search follows no symbolic link.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from mambaloc.errors import InputError
from mambaloc.files import path_inside
from mambaloc.images import IMAGE_SUFFIXES, list_images

SMALLER = ("_2", "_4", "_8")
"""What the folders of smaller copies add to a folder's name, the largest first: those of splatting data sets."""

_OTHER = re.compile(r"depth|mask|semantic|label|normal|confidence", re.IGNORECASE)  # folders of no images
_MAX_FILES = 1_000_000
_LONGEST_NAME = 255  # bytes
_GIVE = "Give the folder of the images with --images."

Parts = tuple[str, ...]


@dataclass(frozen=True)
class Found:
    """Where the images are that a source names.

    Args:
        files: of each name, there or not.
        missing: those that are not.
        elsewhere: how those were found that are not where their names say, in a line; empty where all are.
    """

    files: tuple[Path, ...]
    missing: frozenset[Path] = frozenset()
    elsewhere: str = ""

    @property
    def choices(self) -> dict[str, str]:
        """What was decided."""
        return {"pictures": self.elsewhere} if self.elsewhere else {}


def find_images(root: Path, named: Sequence[tuple[Any, str]]) -> Found:
    """Find images by the paths that a source has for them, with an image's suffix or without.

    An image that is not where its path says is looked for in the folders of smaller copies, as ``images_4`` of
    ``images``, and then by the longest end of its path that a file below the root has. An end of the file's name alone
    counts only where all paths are of one folder: otherwise the folder may be what distinguishes images. An image with
    another suffix counts where its folder is called as the path says, or is the root: elsewhere it may be depth.

    Args:
        root: the folder that paths are relative to.
        named: paths, with either kind of slash, and what names each, for messages; in JSON a path may be anything.

    Raises:
        InputError: for a path that no file has, that leads out of the root where no image below ends like it, or that
            may mean two images; and where no image is there.
    """
    direct = [path_inside(root, name) if isinstance(name, str) else None for name, _ in named]
    files = [None if path is None else _there(root, path) for path in direct]
    lost = [row for row, file in enumerate(files) if file is None]
    tails = _Tails(root)
    moved = _by_tails(tails, [named[row] for row in lost], {file for file in files if file}, named) if lost else []
    for row, file in zip(lost, moved, strict=True):
        files[row] = file
    outside = [row for row in lost if direct[row] is None]
    if outside and not any(files[row] for row in outside):
        name, where = named[outside[0]]
        raise InputError(
            f"{where}: names {name[:60]!r}, which is not a file inside {root}, and no image there has that path's "
            f"end. {_GIVE}"
        )
    if not any(files):
        others = next(iter(tails.known.values()), None)
        there = f", while {'/'.join(others[0])!r} is there" if others else ""
        raise InputError(
            f"{root}: has no image with a pose; {len(named)} are named and missing, such as {named[0][0][-60:]!r}"
            f"{there}. {_GIVE}"
        )
    absent = {row: direct[row] or root / path_parts(named[row][0])[-1] for row in lost if files[row] is None}
    every = tuple(file or absent[row] for row, file in enumerate(files))
    return Found(every, frozenset(absent.values()), _how_found(root, named, every, [row for row in lost if files[row]]))


def count_there(folder: Path, names: Sequence[str]) -> int:
    """How many names are of images in a folder: all as they are written, or else all without their suffixes."""
    paths = [path for name in names if (path := path_inside(folder, name)) is not None]
    if count := sum(path.is_file() for path in paths):
        return count
    stems = {parent: {image.stem for image in list_images(parent)} for parent in {path.parent for path in paths}}
    return sum(path.stem in stems[path.parent] for path in paths)


def _by_tails(
    tails: _Tails, lost: Sequence[tuple[Any, str]], taken: set[Path], named: Sequence[tuple[Any, str]]
) -> list[Path | None]:
    """The image of each path that is not where it says, if one below the root has its end and no other path.

    Raises:
        InputError: for a path that no file has, or that may mean two images.
    """
    for name, where in lost:
        if not isinstance(name, str) or not _is_possible(tails.root, name):
            raise InputError(
                f"{where}: names {str(name)[:60]!r}, which is not a file inside {tails.root}; write the image's path "
                "there"
            )
    min_parts = 1 if len({path_parts(name)[:-1] for name, _ in named}) == 1 else 2
    found = [tails.find(path_parts(name), min_parts, name, where) for name, where in lost]
    return [None if file in taken else file for file in found]


def _is_possible(root: Path, name: str) -> bool:
    """Whether a file may have the name of a path, with a suffix if it has none."""
    longest = "/".join(path_parts(name))
    longest += max(map(len, IMAGE_SUFFIXES)) * "_" if longest and not _has_suffix(longest) else ""
    return path_inside(root, longest) is not None


def _how_found(root: Path, named: Sequence[tuple[Any, str]], files: Sequence[Path], moved: Sequence[int]) -> str:
    """How images were found that are not where their names say."""
    ways: dict[str, list[int]] = {"by the ends of their paths": [], "by their names without suffix": []}
    for row in moved:
        name = path_parts(named[row][0])[-1]
        is_spelled = not _has_suffix(name) or PurePosixPath(name).suffix.lower() == files[row].suffix.lower()
        ways["by the ends of their paths" if is_spelled else "by their names without suffix"].append(row)
    examples = {way: (named[rows[0]][0][-60:], files[rows[0]].relative_to(root)) for way, rows in ways.items() if rows}
    return "; ".join(
        f"{len(ways[way])} of {len(named)} {way}: {name!r} is {place.as_posix()}"
        for way, (name, place) in examples.items()
    )


def path_parts(name: str) -> Parts:
    """The parts of a path of any system, without its drive, ``.`` and what leads up before it."""
    path = PurePosixPath(name.replace("\\", "/"))
    parts = [part for part in path.parts if part not in ("/", "//", ".")]
    if PureWindowsPath(name).drive and parts:
        parts = parts[1:] if parts[0].endswith(":") else parts
    last_up = max((at for at, part in enumerate(parts) if part == ".."), default=-1)
    return tuple(parts[last_up + 1 :])


def _there(root: Path, path: Path) -> Path | None:
    """The image of a path, by itself, with a suffix, or as a smaller copy; None if no file exists."""
    ends = ("", *SMALLER) if path.parent != root else ("",)
    for end in ends:
        parent = path.parent.with_name(path.parent.name + end) if end else path.parent
        for name in _spelled(path.name):
            if (parent / name).is_file():
                return parent / name
    return None


def _spelled(name: str) -> Iterator[str]:
    """An image's name with the suffixes that may be missing."""
    if _has_suffix(name):
        yield name
    else:
        spelled = (name + suffix for suffix in (*IMAGE_SUFFIXES, *map(str.upper, IMAGE_SUFFIXES)))
        yield from (each for each in spelled if len(each.encode()) <= _LONGEST_NAME)


def _has_suffix(name: str) -> bool:
    return PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES


class _Tails:
    """The images below a folder, which is walked once, when they are asked for."""

    def __init__(self, root: Path) -> None:
        self.root = root

    @cached_property
    def known(self) -> Mapping[str, list[Parts]]:
        """Their paths, by their names without suffix."""
        known: dict[str, list[Parts]] = defaultdict(list)
        inside = self.root.resolve()
        for at, (folder, folders, names) in enumerate(os.walk(self.root)):
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            if at + len(known) > _MAX_FILES:
                raise InputError(f"{self.root}: has more than {_MAX_FILES} files and folders below. {_GIVE}")
            for name in names:
                file = Path(folder, name)
                if file.suffix.lower() in IMAGE_SUFFIXES and (
                    not file.is_symlink() or file.resolve().is_relative_to(inside)
                ):
                    known[_folded(file.stem)].append(file.relative_to(self.root).parts)
        return known

    def find(self, parts: Parts, min_parts: int, name: str, where: str) -> Path | None:
        """The image with the longest common end, of so many parts at least.

        Raises:
            InputError: where two have it.
        """
        *folders, file = parts
        spelled = set(_spelled(file))
        folded = set(map(_folded, spelled))
        stem = PurePosixPath(file).stem if _has_suffix(file) else file
        found: dict[tuple[int, bool], list[Parts]] = defaultdict(list)
        for known in self.known.get(_folded(stem), ()):
            length, is_named = 1 + _common(known[:-1], folders), _folded(known[-1]) in folded
            if length == 1 and len(known) > 1 and (not is_named or _OTHER.search(known[-2])):
                continue
            if length >= min_parts:
                found[length, is_named].append(known)
        if not found:
            return None
        best = sorted(found[max(found)])
        best = _largest(best) if max(found)[0] > 1 else best  # of a bare name a folder may be another camera's
        exact = [known for known in best if known[-1] in spelled]
        best = exact if len(exact) == 1 else best
        if len(best) > 1:
            raise InputError(
                f"{where}: names {name[-60:]!r}, which may be {'/'.join(best[0])} or {'/'.join(best[1])} in "
                f"{self.root}. {_GIVE}"
            )
        return self.root.joinpath(*best[0])


def _common(known: Sequence[str], named: Sequence[str]) -> int:
    """How many folders two paths have in common, from their ends; one of smaller copies counts as the named one."""
    length = 0
    for a, b in zip(map(_folded, reversed(known)), map(_folded, reversed(named)), strict=False):
        if a not in (b, *(b + end for end in SMALLER)):
            break
        length += 1
    return length


def _largest(paths: list[Parts]) -> list[Parts]:
    """Of copies in different sizes the largest; all paths where some are not copies of the others."""
    ends = [next((end for end in SMALLER if path[-2].endswith(end)), "") for path in paths]
    if len({(*path[:-2], path[-2].removesuffix(end)) for path, end in zip(paths, ends, strict=True)}) > 1:
        return paths
    first = min(ends, key=("", *SMALLER).index)
    return [path for path, end in zip(paths, ends, strict=True) if end == first]


def _folded(name: str) -> str:
    """A name as file systems that know no case, or spell accents apart, have it."""
    return unicodedata.normalize("NFC", name).casefold()
