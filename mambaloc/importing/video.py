"""Frames of a video as images: chosen for sharpness and movement, written as JPEG, and kept in the user's cache."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
from rich.console import Console
from rich.progress import track

from mambaloc.importing.frame_choice import choose_frames
from mambaloc.runtime.sources import SourceFrame, frames_of
from mambaloc.user_cache import cached_folder

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp")
"""Suffixes of files that are taken for videos."""

_VERSION = 1  # of what is kept; another one is made again
_JPEG_QUALITY = 95
_NOTE = "note.json"


class VideoFrames(NamedTuple):
    """Chosen frames of a video.

    Args:
        images: the chosen frames by their number in the video, from 0.
        read: how many frames the video had when it was read.
    """

    images: dict[int, Path]
    read: int


def chosen_as_stored(video: Path) -> VideoFrames:
    """Choose frames of a video, and write them with the pixels that the video stores, whatever rotation it asks for.

    Raises:
        InputError: where the video cannot be opened, or the cache not be written.
    """
    folder = cached_folder(f"films/{digest_of([video], _VERSION)}", lambda partial: _write_chosen(video, partial))
    images = {int(path.stem): path for path in sorted(folder.glob("*.jpg"))}
    return VideoFrames(images, json.loads((folder / _NOTE).read_text(encoding="utf-8"))["count"])


def _write_chosen(video: Path, folder: Path) -> None:
    frames, count = frames_of(video, is_upright=False)
    watched = Counted(track(frames, "Choosing frames", count, console=Console(stderr=True), transient=True))
    write_frames(choose_frames(watched), folder)
    (folder / _NOTE).write_text(json.dumps({"count": watched.count}), encoding="utf-8")


class Counted:
    """Frames one after another, and how many there were so far."""

    def __init__(self, frames: Iterable[SourceFrame]) -> None:
        self.frames, self.count = iter(frames), 0

    def __iter__(self) -> Counted:
        return self

    def __next__(self) -> SourceFrame:
        frame = next(self.frames)
        self.count += 1
        return frame


def write_frames(frames: Iterable[SourceFrame], folder: Path) -> tuple[dict[str, float], set[tuple[int, ...]]]:
    """Write frames as JPEG, named by their number in the source; their times by name, and their sizes."""
    time_s, sizes = {}, set()
    for frame in frames:
        name = f"{int(frame.name):06d}.jpg"
        _, data = cv2.imencode(".jpg", frame.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        (folder / name).write_bytes(data.tobytes())
        time_s[name] = frame.time_s
        sizes.add(frame.image.shape[:2])
    return time_s, sizes


def digest_of(files: Iterable[Path], *settings: object) -> str:
    """A short digest of settings and of which files these are: by place, size and time of change, without reading."""
    digest = hashlib.sha256(" ".join(map(str, [*settings, ""])).encode())
    for path in files:
        status = path.stat()
        digest.update(f"{path.resolve()}\0{status.st_size}\0{status.st_mtime_ns}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()[:16]
