"""What structure from motion does not read beside the images: files that may hold their poses."""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path

_SUFFIXES = {
    *(".txt", ".csv", ".tsv", ".json", ".jsonl", ".xml", ".yaml", ".yml", ".tum", ".kitti", ".log", ".nvm", ".out"),
    *(".bin", ".db", ".npy", ".npz", ".mat", ".pkl", ".pickle", ".g2o", ".bag", ".pose", ".trj"),
}
_NO_POSES = re.compile(r"readme|licen[cs]e|notice|copying|requirements", re.IGNORECASE)
_MAX_FILES = 100_000
_NAMED = 3


def pose_like(source: Path) -> list[str]:
    """Files that look like ones of poses, relative to a folder: in it, and in the folders there.

    Of a video, files beside it that bear its name.
    """
    if source.is_file():
        return sorted(path.name for path in source.parent.glob("*") if path.stem == source.stem and _is_like(path))
    files = (path for pattern in ("*", "*/*") for path in source.glob(pattern))
    found = [path.relative_to(source) for path in islice(files, _MAX_FILES) if _is_like(path)]
    return [path.as_posix() for path in sorted(found, key=lambda path: (len(path.parts), path))]


def warning_of(unread: list[str]) -> str:
    """A line that names the files, and what to do."""
    named = ", ".join(unread[:_NAMED]) + (f" and {len(unread) - _NAMED} more" if unread[_NAMED:] else "")
    return (
        f"poses are made from the images alone; not read: {named}. If the poses are there, give that folder, or name "
        "the format with --format."
    )


def _is_like(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES and not _NO_POSES.match(path.name) and path.is_file()
