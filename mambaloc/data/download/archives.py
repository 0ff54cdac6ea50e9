"""Unpack zips from the internet without trusting them."""

from __future__ import annotations

import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from mambaloc.errors import InputError

_CHUNK_BYTES = 1 << 20
_DEEPEST_NESTING = 1  # 7-Scenes keeps one zip per sequence inside the scene's zip
_LITTER = {"Thumbs.db", "desktop.ini", ".DS_Store", "__MACOSX"}


def require_space(folder: Path, needed_bytes: float) -> None:
    """InputError where the disk of ``folder`` has less than ``needed_bytes`` free."""
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < needed_bytes:
        raise InputError(
            f"{folder}: {needed_bytes / 1e9:.1f} GB are needed and {free_bytes / 1e9:.1f} GB are free; "
            "free some space or give a folder on another disk with --root"
        )


def unpack(
    archive: Path, folder: Path, *, limit_bytes: int, on_bytes: Callable[[int], None] = lambda count: None
) -> int:
    """Unpack a zip into ``folder``, and the zips inside it in their places; returns the number of bytes written.

    Every member is judged before the first is written. Litter of operating systems is left out.

    Args:
        archive: the zip file.
        folder: an existing folder.
        limit_bytes: the most that may be written, inner zips included.
        on_bytes: called with the size of every chunk written.

    Raises:
        InputError: not a zip, damaged or encrypted; a member that leaves the folder, is a link or a device, or is
            nested too deep; more bytes than ``limit_bytes``, or than the disk has free.
    """
    return _unpack(archive, archive.name, folder, limit_bytes, on_bytes, depth=0)


def _unpack(
    archive: Path, name: str, folder: Path, limit_bytes: int, on_bytes: Callable[[int], None], depth: int
) -> int:
    try:
        with zipfile.ZipFile(archive) as opened:
            members = _judge(opened, name, limit_bytes, depth)
            require_space(folder, sum(info.file_size for info, _ in members))
            written = 0
            for info, path in members:
                target = folder / path
                written += _write(opened, info, target, on_bytes)
                if _is_zip(path):
                    inner = f"{name}/{path}"
                    written += _unpack(target, inner, target.parent, limit_bytes - written, on_bytes, depth + 1)
                    target.unlink()
            return written
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError) as error:
        raise InputError(f"{name}: cannot be read as a zip ({error}). Delete it and download it again.") from None


def _judge(
    opened: zipfile.ZipFile, name: str, limit_bytes: int, depth: int
) -> list[tuple[zipfile.ZipInfo, PurePosixPath]]:
    """The members to write, with their paths, once every member is found to be harmless."""
    members = []
    for info in opened.infolist():
        if not info.filename:
            raise _untrusted(name, "a member has no name")
        path = PurePosixPath(info.filename.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts or re.match("[A-Za-z]:", str(path)):
            raise _untrusted(name, f"member {info.filename!r} leads out of the folder")
        if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise _untrusted(name, f"member {info.filename!r} is a link or a device")
        if info.is_dir() or _LITTER & set(path.parts):
            continue
        if _is_zip(path) and depth == _DEEPEST_NESTING:
            raise _untrusted(name, f"member {info.filename!r} is a zip nested too deep")
        members.append((info, path))
    total_bytes = sum(info.file_size for info, _ in members)
    if total_bytes > limit_bytes:
        raise _untrusted(name, f"it unpacks to {total_bytes:,} bytes where {limit_bytes:,} are allowed")
    return members


def _write(opened: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path, on_bytes: Callable[[int], None]) -> int:
    # zipfile reads no further than the declared size and checks the CRC, so a member cannot outgrow what was judged.
    target.parent.mkdir(parents=True, exist_ok=True)
    with opened.open(info) as source, target.open("wb") as file:
        while chunk := source.read(_CHUNK_BYTES):
            file.write(chunk)
            on_bytes(len(chunk))
    return info.file_size


def _is_zip(path: PurePosixPath) -> bool:
    return path.suffix.lower() == ".zip"


def _untrusted(name: str, why: str) -> InputError:
    return InputError(f"{name}: {why}; nothing is unpacked: delete the archive and get it from its official address")
