"""The user's cache folder: what is made once, kept, and found again."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock

from mambaloc.errors import InputError
from mambaloc.files import whole_folder


def default_cache_dir() -> Path:
    """``$MAMBALOC_CACHE``, or ``mambaloc`` in the user's cache folder."""
    if "MAMBALOC_CACHE" in os.environ:
        return Path(os.environ["MAMBALOC_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "mambaloc"


def made_once(name: str, make: Callable[[Path], object]) -> Path:
    """A folder of the user's cache: made by who comes first, while others wait, and found again by all.

    Args:
        name: of the folder, below the cache.
        make: fills an empty folder, which gets its name once this ends; an error leaves nothing.

    Raises:
        InputError: where it cannot be written.
    """
    folder, remedy = default_cache_dir() / name, "set MAMBALOC_CACHE to a folder that can be written"
    if folder.is_dir():
        return folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.with_name(f"{folder.name}.lock")):
            if not folder.is_dir():  # another process may have made it meanwhile
                with whole_folder(folder, remedy) as partial:
                    make(partial)
    except OSError as error:
        raise InputError(f"{folder.parent}: cannot be written ({error.strerror}); {remedy}") from None
    return folder
