"""Get a public dataset from its official address: fetched, checked, unpacked, whole or not at all."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from mambaloc.data.datasets.dataset import Archive, Source
from mambaloc.data.datasets.registry import find_source
from mambaloc.data.download.archives import require_space, unpack
from mambaloc.data.download.fetch import UnreachableError, fetch
from mambaloc.errors import InputError
from mambaloc.files import sha256

_UNPACKED_PER_BYTE = 1.2  # images hardly compress; the margin holds one inner zip
_MAX_UNPACKED_PER_BYTE = 10
_SMALL_BYTES = 64 << 20


def download(
    dataset: str | Source,
    scene: str | None,
    root: Path | None = None,
    *,
    keep_archive: bool = False,
    accept_changed: bool = False,
    pause_s: float = 1.0,
) -> list[Path]:
    """Get a scene, or ``"all"`` scenes, into ``root/<scene>``; a scene that is there already is left alone.

    A zip found as ``root/<scene>.zip`` is used instead of the network, and kept. Size, sha256, address and date are
    recorded in ``root/<scene>.download.json``.

    Args:
        dataset: a name in ``SOURCES``, or a source of one's own.
        scene: the scene's name, or ``"all"``.
        root: the folder that holds the scenes, ``data/<dataset>`` by default.
        keep_archive: leave the downloaded zip beside the scene.
        accept_changed: take an archive whose size or checksum is not the known or recorded one.
        pause_s: the wait before a retry, doubled each time.

    Raises:
        InputError: unknown name, address out of reach, disk full, archive changed, damaged or unsafe.
    """
    source = find_source(dataset) if isinstance(dataset, str) else dataset
    if scene is None:
        raise InputError(f"{source.name} needs a scene: give one of {', '.join(source.archives)}, or all")
    if scene != "all":
        source.find_scene(scene)
    root = source.default_root if root is None else root
    scenes = list(source.archives) if scene == "all" else [scene]
    return [_get(source, name, root, keep_archive, accept_changed, pause_s) for name in scenes]


def _get(source: Source, scene: str, root: Path, keep_archive: bool, accept_changed: bool, pause_s: float) -> Path:
    target, archive = root / scene, root / f"{scene}.zip"
    with _disk_errors_in_a_line(root):
        if _is_complete(source, target):
            print(f"{target} is complete: nothing to do")
            return target
        with _alone(root, scene):
            print(f"{source.title}, {source.licence}: {source.terms}; project page {source.page}")
            found = archive.exists()
            url = None if found else _fetch(source, scene, archive, accept_changed, pause_s)
            record = _identify(source, scene, archive, url, accept_changed)
            _install(source, archive, target)
            _record_of(archive).write_text(json.dumps(record, indent=2) + "\n")
            if not found and not keep_archive:
                archive.unlink()
    print(f"{target} is ready" + (f"; the archive {archive} is kept" if archive.exists() else ""))
    return target


def _is_complete(source: Source, target: Path) -> bool:
    if not target.is_dir() or not any(target.iterdir()):
        return False
    missing = source.missing(target)
    if missing is not None:
        raise InputError(
            f"{target}: the folder exists, but {missing} is missing. Move the folder away and run this again."
        )
    return True


def _fetch(source: Source, scene: str, archive: Path, accept_changed: bool, pause_s: float) -> str:
    known = source.archives[scene]
    with _bar(f"{scene}.zip") as (progress, task):

        def judge(size_bytes: int | None, start: int) -> None:
            if size_bytes is not None:
                _check_size(size_bytes, known, f"{scene}.zip on the server", accept_changed)
                require_space(archive.parent, size_bytes * (1 + _UNPACKED_PER_BYTE) - start)
            progress.reset(task, total=size_bytes, completed=start)

        try:
            offer = fetch(
                known.urls, archive, on_offer=judge, on_bytes=lambda n: progress.advance(task, n), pause_s=pause_s
            )
        except UnreachableError as reason:
            raise InputError(
                f"{archive.name} is out of reach: {reason}; run this again to resume, or get {known.urls[-1]} with a "
                f"browser (project page {source.page}), save it as {archive} and run this again"
            ) from None
    return offer.url


def _identify(source: Source, scene: str, archive: Path, url: str | None, accept_changed: bool) -> dict[str, object]:
    """The archive's record, once its size and checksum are found to be the known and the recorded ones."""
    known, size_bytes = source.archives[scene], archive.stat().st_size
    _check_size(size_bytes, known, str(archive), accept_changed)
    print(f"checking {archive}")
    digest = sha256(archive)
    for expected, whose in ((known.sha256, "known"), (_recorded_sha256(archive), f"in {_record_of(archive).name}")):
        if expected not in (None, digest) and not accept_changed:
            raise InputError(
                f"{archive} has sha256 {digest}, the one {whose} is {expected}: delete it and run this again, "
                "or take it as it is with --accept-changed"
            )
    return {
        "dataset": source.name,
        "scene": scene,
        "url": url,  # None: the archive was there already
        "size_bytes": size_bytes,
        "sha256": digest,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "licence": source.licence,
    }


def _record_of(archive: Path) -> Path:
    return archive.with_suffix(".download.json")


def _recorded_sha256(archive: Path) -> str | None:
    try:
        return str(json.loads(_record_of(archive).read_text())["sha256"])
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return None


def _check_size(size_bytes: int, known: Archive, what: str, accept_changed: bool) -> None:
    if known.size_bytes not in (None, size_bytes) and not accept_changed:
        raise InputError(
            f"{what} has {size_bytes:,} bytes, the known one has {known.size_bytes:,}: it is incomplete or another "
            "version; delete any copy of it here and run this again, or take it as it is with --accept-changed"
        )


def _install(source: Source, archive: Path, target: Path) -> None:
    """Unpack beside ``target`` and rename at the end, so that a killed run never leaves half a scene."""
    unpacking = target.with_name(f".{target.name}.unpacking")
    shutil.rmtree(unpacking, ignore_errors=True)  # what a killed run left
    unpacking.mkdir()
    try:
        limit_bytes = max(archive.stat().st_size * _MAX_UNPACKED_PER_BYTE, _SMALL_BYTES)
        with _bar(f"unpacking {archive.name}") as (progress, task):
            unpack(archive, unpacking, limit_bytes=limit_bytes, on_bytes=lambda n: progress.advance(task, n))
        if target.is_dir():
            target.rmdir()  # empty, and in the way of the rename
        _scene_in(unpacking, source, archive).replace(target)
    finally:
        shutil.rmtree(unpacking, ignore_errors=True)


def _scene_in(folder: Path, source: Source, archive: Path) -> Path:
    """Where the split files are: in ``folder``, or in a folder that the archive wraps around everything."""
    for candidate in (folder, *(path for path in folder.iterdir() if path.is_dir())):
        if all((candidate / split).is_file() for split in source.splits):
            return candidate
    raise InputError(f"{archive}: contains no {' and '.join(source.splits)}, so it is not a scene of {source.title}")


@contextmanager
def _bar(label: str) -> Iterator[tuple[Progress, TaskID]]:
    columns = (BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with Progress(TextColumn("{task.description}"), *columns) as progress:
        yield progress, progress.add_task(label, total=None)


@contextmanager
def _alone(root: Path, scene: str) -> Iterator[None]:
    root.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(root / f".{scene}.lock", timeout=0):
            yield
    except Timeout:
        raise InputError(f"{root / scene}: another process is getting this scene; wait for it to finish") from None


@contextmanager
def _disk_errors_in_a_line(root: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        remedy = "free some space and run this again" if full else "see that the folder can be written, or give --root"
        raise InputError(f"{error.filename or root}: {error.strerror or error}; {remedy}") from None
