"""Images without poses, a video or a folder of photos: posed by structure from motion.

Frames of a video are chosen for sharpness and movement, and matched with their neighbours; of a few photos every
pair is. All images of one size share a camera with a radial distortion. The scale is arbitrary. What was made is kept
in the user's cache and found again, unless the images change.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from mambaloc.data.colmap import import_pycolmap
from mambaloc.errors import InputError
from mambaloc.images import Counts, list_images, read_image
from mambaloc.importing.capture import Capture
from mambaloc.importing.formats.colmap import read_colmap
from mambaloc.importing.formats.parsing import first_with_images, folder_name
from mambaloc.importing.frame_choice import choose_frames
from mambaloc.importing.sfm.process import Job, reconstruct
from mambaloc.importing.sfm.unread import pose_like, warning_of
from mambaloc.importing.undistort.decoding import choices_of, counts_of
from mambaloc.importing.video import VIDEO_SUFFIXES, Counted, digest_of, write_frames
from mambaloc.runtime.sources import IMAGES_HZ, SourceFrame, frames_of
from mambaloc.user_cache import cached_folder

_NEIGHBOURS = 10  # before and after a video's frame that it is matched with, beside those 2, 4, 8, ... apart
_VERSION = 1  # of what is kept: another one is made again
_MAX_IMAGES = 60  # every pair of so many is matched; a folder of more is taken for a video's frames
_MAX_FRAMES = 400  # of a video: placing a hundred takes minutes
_FEWEST_FRAMES = 5
_MIN_PLACED = 0.5
_ADVICE = (
    "film slowly and sideways rather than turning on the spot, with texture, light and little motion in view, and "
    "return to where you began"
)


def is_video_or_images(source: Path) -> bool:
    """Whether a source is a video, or a folder with images in it or in ``images``."""
    if source.is_file():
        return source.suffix.lower() in VIDEO_SUFFIXES
    return bool(list_images(source) or list_images(source / "images"))


def read_structure(source: Path, threads: int = -1, seed: int = 0) -> Capture:
    """Choose frames, pose them, and read what was placed.

    Args:
        source: a video, or a folder of images.
        threads: that finding and matching features take; -1 for all. What is found does not depend on it.
        seed: of RANSAC.

    Raises:
        InputError: without pycolmap, where the source cannot be read, or too few frames could be placed.
    """
    import_pycolmap(source)
    unread = pose_like(source)
    if unread:
        console = Console(stderr=True, highlight=False)
        console.print(f"{source}: {warning_of(unread)}", markup=False, soft_wrap=True)
    source = source if source.is_file() else first_with_images([source, source / "images"])
    digest = digest_of([source] if source.is_file() else list_images(source), _VERSION, seed)
    folder = cached_folder(f"structure/{digest}", lambda partial: _make(source, partial, threads, seed))
    note = json.loads((folder / "note.json").read_text(encoding="utf-8"))
    capture = read_colmap(folder)
    placed = set(capture.images)
    name = source.stem if source.is_file() else folder_name(source)
    kept = {"direction": "camera-to-world", "model": f"{folder.parent.name}/{folder.name} of the cache"}
    kept |= {"not read": warning_of(unread)} if unread else {}
    return replace(
        capture,
        kind="structure_from_motion",
        sequences=(name,) * len(capture.images),
        choices={**capture.choices, **kept, **note["choices"]},
        time_s=np.array([note["time_s"][image.name] for image in capture.images]) if note["time_s"] else None,
        images_without_pose=tuple(image for image in list_images(folder / "images") if image not in placed),
    )


def _make(source: Path, folder: Path, threads: int, seed: int) -> None:
    """Fill a folder with chosen images, the largest model, and a note of what was decided."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    images = folder / "images"
    images.mkdir()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        counts = None if source.is_file() else counts_of(list_images(source))
        frames, total = frames_of(source) if source.is_file() else _of_images(source, counts)
        is_video = source.is_file() or (total or 0) > _MAX_IMAGES
        seen = Counted(progress.track(frames, total=total, description="Choosing frames"))
        time_s, sizes = write_frames(choose_frames(seen) if is_video else seen, images)
        names = _thinned(images, sorted(time_s))
        if len(names) < _FEWEST_FRAMES:
            few = f"{len(names)} frames that differ, of {_FEWEST_FRAMES} at least"
            raise InputError(f"{source}: shows {few}; {_ADVICE}")
        neighbours = _NEIGHBOURS if is_video else None
        job = Job(images, names, folder / "sparse/0", len(sizes) == 1, neighbours, threads, seed)
        placed = reconstruct(job, source, _ADVICE, progress)
    share = f"{placed} of {len(names)} frames"
    if placed < max(_FEWEST_FRAMES, _MIN_PLACED * len(names)):
        raise InputError(f"{source}: only {share} could be placed, less than {_MIN_PLACED:.0%}; {_ADVICE}")
    chosen = f"{len(names)} of {seen.count}, by sharpness and movement"
    choices = {
        "frames": chosen if is_video else f"all {len(names)} photos",
        "matching": f"{_NEIGHBOURS} neighbours of each, and farther ones" if is_video else "every pair",
        "registered": f"{share} ({placed / len(names):.0%})",
        **choices_of(counts),
    }
    note = {"choices": choices, "time_s": {name: time_s[name] for name in names} if source.is_file() else {}}
    (folder / "note.json").write_text(json.dumps(note, indent=2), encoding="utf-8")


def _of_images(folder: Path, counts: Counts | None) -> tuple[Iterator[SourceFrame], int]:
    """A folder's images in natural order, as frames."""
    paths = list_images(folder)
    return (SourceFrame(str(at), at / IMAGES_HZ, read_image(path, counts)) for at, path in enumerate(paths)), len(paths)


def _thinned(folder: Path, names: list[str]) -> list[str]:
    """Keep at most so many frames, evenly."""
    rows = np.unique(np.linspace(0, len(names) - 1, min(_MAX_FRAMES, len(names))).round().astype(int))
    kept = [names[row] for row in rows.tolist()]
    for name in set(names) - set(kept):
        (folder / name).unlink()
    return kept
