"""Files: their digests, and folders that are there whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from mambaloc.errors import InputError
from mambaloc.text import decode_text

_MAX_VALUES = 10**6
_MAX_JSON_BYTES = 2**30
_LONGEST_PATH = 1024  # bytes; 255 for each part, as file systems have it


def shipped_folder(name: str) -> Path:
    """Return ``zoo`` or ``recipes``: inside the package where it is installed, beside it in a checkout."""
    package = Path(str(resources.files("mambaloc")))
    shipped = package / "shipped" / name
    return shipped if shipped.is_dir() else package.parent / name


def sha256(path: Path) -> str:
    """Digest of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_yaml(path: Path, missing: str, broken: str) -> Any:
    """Read plain data from a YAML file.

    Args:
        path: the file.
        missing: what the user may do where it cannot be read.
        broken: what the user may do where it is not YAML.

    Raises:
        InputError: in either case.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {missing}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not YAML ({error}); {broken}") from None
    return parse_yaml(text, path, broken)


def parse_yaml(text: str, path: Path, broken: str) -> Any:
    """Plain data of a YAML file's text; the arguments and errors are those of :func:`read_yaml`."""
    import yaml  # only here: exported models run without it

    try:
        data = yaml.safe_load(text)
        if _expanded(data, {}) > _MAX_VALUES:
            raise InputError(f"{path}: its aliases stand for more than {_MAX_VALUES} values; write them out")
        return data
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # a ValueError: a number too long, or no date
        raise InputError(f"{path}: is not YAML ({str(error).splitlines()[0]}); {broken}") from None


def _expanded(value: Any, known: dict[int, int]) -> int:
    """How many values it holds once each alias is written out."""
    if not isinstance(value, dict | list):
        return 1
    if id(value) not in known:
        known[id(value)] = _MAX_VALUES  # if it holds itself
        items = value.values() if isinstance(value, dict) else value
        known[id(value)] = 1 + sum(_expanded(item, known) for item in items)
    return known[id(value)]


def read_json(path: Path, missing: str, broken: str) -> Any:
    """Read plain data from a JSON file of at most 1 GiB; the arguments and errors are those of :func:`read_yaml`."""
    try:
        if path.stat().st_size > _MAX_JSON_BYTES:
            raise InputError(f"{path}: is larger than {_MAX_JSON_BYTES} bytes; {broken}")
        return json.loads(decode_text(path.read_bytes()))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {missing}") from None
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError, and so is a number too long
        raise InputError(f"{path}: is not JSON ({str(error).splitlines()[0]}); {broken}") from None


def path_inside(folder: Path, name: str) -> Path | None:
    """The path that a name in somebody's file means, below a folder; None where it leads out, or no file has it."""
    path = PurePosixPath(name.replace("\\", "/"))
    try:
        is_short = len(name.encode()) <= _LONGEST_PATH and all(len(part.encode()) <= 255 for part in path.parts)
    except UnicodeEncodeError:  # half a surrogate pair, as JSON may hold
        return None
    leaves = path.is_absolute() or ".." in path.parts or PureWindowsPath(name).drive
    return None if leaves or not path.parts or not is_short or "\0" in name else folder / path


@contextmanager
def writing(folder: Path, remedy: str = "choose another folder with --out") -> Iterator[None]:
    """Raise an OSError of the block, which writes to a folder, as an InputError of one line.

    Args:
        folder: named in the message.
        remedy: what the user may do where it cannot be written.

    Raises:
        InputError: where it cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error}); {remedy}") from None


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Give a file beside a path to write to, which gets its name once the block ends; an error leaves nothing."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")  # nobody else's
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path, remedy: str) -> Iterator[Path]:
    """Give an empty folder to write to, which gets its name once the block ends; an error leaves nothing.

    Args:
        folder: the name; its parents are made.
        remedy: what the user may do where it cannot be written.

    Raises:
        InputError: where it cannot be written, or is there by then, or the block cannot read a file.
    """
    partial = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))  # nobody else's
        yield partial
        partial.chmod(0o755)  # a temporary folder is its owner's alone
        partial.replace(folder)
    except OSError as error:
        file = Path(error.filename) if isinstance(error.filename, str) else folder
        where = folder if partial is None or file.is_relative_to(partial) else file
        raise InputError(f"{where}: {error.strerror or error}; {remedy}") from None
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)


def claim_space(file: Path) -> None:
    """Fill a sparse file's holes: writing into them through a memory map on a full disk is a bus error."""
    if hasattr(os, "posix_fallocate"):
        with file.open("r+b") as opened:
            os.posix_fallocate(opened.fileno(), 0, file.stat().st_size)
