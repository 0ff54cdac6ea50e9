"""Splits that a capture gives as lists of names, as ``train_filenames`` and its like of nerfstudio."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Any

from mambaloc.images import IMAGE_SUFFIXES
from mambaloc.importing.formats.finding import path_parts

_SHOWN = 3  # names in a line


@dataclass(frozen=True)
class Given:
    """A split that lists of names give.

    Args:
        split: of each row that a list names.
        choices: what was decided.
        concern: what is wrong with the lists, in a line; empty where nothing is.
    """

    split: dict[int, str]
    choices: dict[str, str]
    concern: str = ""


def given_split(names: Sequence[Any], lists: Mapping[str, Sequence[str]]) -> Given:
    """Find the frames that lists name: by their paths, or by the ends of these where one frame alone has such an end.

    Validation frames are the test split where a capture lists no others to test on. A frame of several lists is never
    trained on, and tested on if it may be.

    Args:
        names: of frames, as the source has them.
        lists: names by split: ``train``, ``val``, ``test``.
    """
    rows_of: dict[tuple[str, ...], list[int]] = defaultdict(list)
    for row, name in enumerate(names):
        parts = _parts(name)
        for start in range(len(parts)):
            rows_of[parts[start:]].append(row)
    found: dict[int, str] = {}
    unknown: list[str] = []
    twice = 0
    for split in ("train", "val", "test"):
        for name in lists.get(split, ()):
            of = _row(_parts(name), rows_of, names)
            if of is None:
                unknown.append(name)
                continue
            twice += found.get(of, split) != split
            found[of] = split
    return replace(_with_test(found, unknown, twice), concern=_concern(found, unknown, names))


def _concern(found: Mapping[int, str], unknown: Sequence[str], names: Sequence[Any]) -> str:
    """What is wrong with lists that name others than the frames, with a name of each side."""
    if not unknown:
        return ""
    example = f"{unknown[0][-60:]!r} is listed, {str(names[0])[-60:]!r} is a frame"
    if not found:
        return f"lists of names that are of none of its frames ({example})"
    return f"lists with {len(unknown)} names of no frame, or of several ({example})"


def _with_test(found: dict[int, str], unknown: Sequence[str], twice: int) -> Given:
    notes = []
    if "val" in found.values() and "test" not in found.values():
        found = {row: "test" if split == "val" else split for row, split in found.items()}
        notes.append("the validation frames are the test split, since the capture lists no test frames")
    if twice:
        notes.append(f"{twice} names are in more than one list: such frames are not trained on")
    if unknown:
        more = ", ..." if len(unknown) > _SHOWN else ""
        notes.append(f"{len(unknown)} listed names are of no frame, or of several: {', '.join(unknown[:_SHOWN])}{more}")
    return Given(found, {"split": "; ".join(notes)} if notes else {})


def _row(parts: tuple[str, ...], rows_of: Mapping[tuple[str, ...], list[int]], names: Sequence[Any]) -> int | None:
    """The one frame whose path is, ends in, or is the end of a listed one."""
    for start in range(len(parts)):
        rows = rows_of.get(parts[start:], [])
        if start or len(rows) != 1:  # else it is the only one that ends so
            rows = [row for row in rows if len(_parts(names[row])) == len(parts) - start]
        if len(rows) == 1:
            return rows[0]
    return None


def _parts(name: Any) -> tuple[str, ...]:
    """A path's parts, without an image's suffix, which frames may omit."""
    *folders, file = path_parts(str(name)) or ("",)
    path = PurePosixPath(file)
    return *folders, path.stem if path.suffix.lower() in IMAGE_SUFFIXES else file
