"""Files: their digests, and folders that are there whole or not at all."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
