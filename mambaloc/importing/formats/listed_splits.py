"""Splits that a capture gives as lists of names, as ``train_filenames`` and its like of nerfstudio."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from mambaloc.images import PICTURES
from mambaloc.importing.formats.finding import path_parts

_SHOWN = 3  # names in a line


def given_split(names: Sequence[Any], lists: Mapping[str, Sequence[str]]) -> tuple[dict[int, str], dict[str, str]]:
    """Find the frames that lists name: by their paths, or by the ends of these where one frame alone has such an end.

    Validation frames are the test split where a capture lists no others to test on. A frame of several lists is never
    trained on, and tested on if it may be.

    Args:
        names: of frames, as the source has them.
        lists: names by split: ``train``, ``val``, ``test``.

    Returns:
        The split of each row that a list names, and what was decided, for ``choices``.
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
    return _with_test(found, unknown, twice)


def _with_test(found: dict[int, str], unknown: Sequence[str], twice: int) -> tuple[dict[int, str], dict[str, str]]:
    said = []
    if "val" in found.values() and "test" not in found.values():
        found = {row: "test" if split == "val" else split for row, split in found.items()}
        said.append("the validation frames are the test split, since the capture lists no test frames")
    if twice:
        said.append(f"{twice} names are in more than one list: such frames are not trained on")
    if unknown:
        more = ", ..." if len(unknown) > _SHOWN else ""
        said.append(f"{len(unknown)} listed names are of no frame, or of several: {', '.join(unknown[:_SHOWN])}{more}")
    return found, {"split": "; ".join(said)} if said else {}


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
    """A path's parts, without a picture's suffix, as frames may lack it."""
    *folders, file = path_parts(str(name)) or ("",)
    path = PurePosixPath(file)
    return *folders, path.stem if path.suffix.lower() in PICTURES else file
