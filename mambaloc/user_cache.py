"""The user's cache folder: what is made once, kept, and found again."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.files import atomic_folder
from mambaloc.images import END_BYTES

_ARRAYS = "arrays.npz"


def default_cache_dir() -> Path:
    """``$MAMBALOC_CACHE``, or ``mambaloc`` in the user's cache folder."""
    if "MAMBALOC_CACHE" in os.environ:
        return Path(os.environ["MAMBALOC_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "mambaloc"


def cached_folder(
    name: str,
    make: Callable[[Path], object],
    cache_dir: Path | None = None,
    remedy: str = "set MAMBALOC_CACHE to a folder that can be written",
) -> Path:
    """A folder of the user's cache: made by who comes first, while others wait, and found again by all.

    Args:
        name: of the folder, below the cache.
        make: fills an empty folder, which gets its name once this ends; an error leaves nothing.
        cache_dir: the cache; the user's own unless given.
        remedy: what the user may do where it cannot be written.

    Raises:
        InputError: where it cannot be written.
    """
    folder = (cache_dir or default_cache_dir()) / name
    if folder.is_dir():
        return folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.with_name(f"{folder.name}.lock")):
            if not folder.is_dir():  # another process may have made it meanwhile
                with atomic_folder(folder, remedy) as partial:
                    make(partial)
    except OSError as error:
        raise InputError(f"{folder.parent}: cannot be written ({error.strerror}); {remedy}") from None
    return folder


def cached_arrays(name: str, make: Callable[[], dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Arrays by their names, kept in a folder of :func:`cached_folder`; nothing in it is ever unpickled.

    Raises:
        InputError: where the folder cannot be written, or its file is damaged.
    """
    file = cached_folder(name, lambda folder: np.savez(folder / _ARRAYS, **make())) / _ARRAYS  # type: ignore[arg-type]
    try:
        with np.load(file) as arrays:
            return dict(arrays)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{file}: is damaged ({error}). Remove {file.parent} to have it made again.") from None


def fingerprint(path: Path) -> bytes:
    """Size, first and last bytes: a PNG's end holds its checksum, so any change of its pixels shows there."""
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            head = file.read(END_BYTES)
            file.seek(max(0, size - END_BYTES))
            return hashlib.sha256(f"{size}\0".encode() + head + file.read()).digest()
    except OSError:
        return b"missing"
