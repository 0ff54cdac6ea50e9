"""Files: their digests, and folders that are there whole or not at all."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock

from mambaloc.errors import InputError


def sha256(path: Path) -> str:
    """Digest of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def whole_folder(folder: Path, remedy: str) -> Iterator[Path]:
    """Give an empty folder to write to, which gets its name once the block ends; an error leaves nothing.

    Args:
        folder: the name; its parents are made.
        remedy: what the user may do where it cannot be written.

    Raises:
        InputError: where it cannot be written.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        yield partial
        partial.replace(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); {remedy}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def made_once(folder: Path, make: Callable[[Path], object]) -> Path:
    """A folder of the user's cache: made by who comes first, while others wait, and found again by all.

    Args:
        folder: its name.
        make: fills an empty folder, which gets its name once this ends; an error leaves nothing.

    Raises:
        InputError: where it cannot be written.
    """
    remedy = "set MAMBALOC_CACHE to a folder that can"
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
