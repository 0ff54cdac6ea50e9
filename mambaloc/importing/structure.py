"""Pictures without poses, a film or a folder of photographs: posed by structure from motion (COLMAP, on the CPU).

SIFT features (Lowe 2004), matched between neighbours in a film and between all of a few photographs, incremental
mapping (Schönberger and Frahm 2016), one camera with a radial distortion for all pictures of one size. The scale is
arbitrary. What was made is kept in the user's cache and found again, unless the pictures change.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from mambaloc.data.colmap import import_pycolmap
from mambaloc.errors import InputError
from mambaloc.images import read_image
from mambaloc.importing.capture import Capture
from mambaloc.importing.colmap import read_colmap
from mambaloc.importing.frame_choice import choose_frames
from mambaloc.importing.untrusted import first_with_pictures, folder_name, pictures
from mambaloc.runtime.sources import SourceFrame, frames_of
from mambaloc.user_cache import made_once

FILMS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp")
"""Suffixes of files that are taken for films."""

_VERSION = 1  # of what is kept: another one is made anew
_MOST_PHOTOGRAPHS = 60  # every pair of so many is matched; a folder of more is taken for a film's frames
_MOST_FRAMES = 400  # of a film: mapping takes minutes for a hundred
_FEWEST_FRAMES = 5
_LEAST_PLACED = 0.5
_FEATURES, _LONGEST_PX = 4096, 1600
_NEIGHBOURS = 10
_JPEG_QUALITY = 95
_ADVICE = (
    "film slowly and sideways rather than turning on the spot, with texture, light and little motion in view, and "
    "return to where you began"
)


def is_pictures(source: Path) -> bool:
    """Whether a source is a film, or a folder with pictures in it or in ``images``."""
    if source.is_file():
        return source.suffix.lower() in FILMS
    return bool(pictures(source) or pictures(source / "images"))


def read_structure(source: Path, threads: int = -1, seed: int = 0) -> Capture:
    """Choose frames, pose them, and read what was placed.

    Args:
        source: a film, or a folder of pictures.
        threads: that finding and matching features take; -1 for all. The result does not depend on it.
        seed: of RANSAC.

    Raises:
        InputError: without pycolmap, where the source cannot be read, or too few frames could be placed.
    """
    import_pycolmap(source)
    source = source if source.is_file() else first_with_pictures([source, source / "images"])
    folder = made_once(f"structure/{_digest(source, seed)}", lambda partial: _make(source, partial, threads, seed))
    note = json.loads((folder / "note.json").read_text(encoding="utf-8"))
    capture = read_colmap(folder)
    unplaced = [image for image in pictures(folder / "images") if image not in set(capture.images)]
    name = source.stem if source.is_file() else folder_name(source)
    return replace(
        capture,
        kind="structure_from_motion",
        sequences=(name,) * len(capture.images),
        choices={
            **capture.choices,
            **note["choices"],
            "direction": "camera-to-world",
            "model": f"{folder.parent.name}/{folder.name} of the cache",
        },
        time_s=np.array([note["time_s"][image.name] for image in capture.images]) if note["time_s"] else None,
        images_without_pose=tuple(unplaced),
    )


def _digest(source: Path, seed: int) -> str:
    """Which pictures these are: by place, size and time of change, without reading them."""
    digest = hashlib.sha256(f"{_VERSION} {seed} {source.resolve()}".encode())
    for path in [source] if source.is_file() else pictures(source):
        status = path.stat()
        digest.update(f"{path.name}\0{status.st_size}\0{status.st_mtime_ns}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()[:16]


def _make(source: Path, folder: Path, threads: int, seed: int) -> None:
    """Fill a folder with chosen images, the largest model of them, and a note of what was decided."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        frames, total = frames_of(source) if source.is_file() else _of_pictures(source)
        seen = iter(progress.track(frames, total=total, description="Choosing frames"))
        is_film = source.is_file() or (total or 0) > _MOST_PHOTOGRAPHS
        (folder / "images").mkdir()
        time_s, sizes = _write(choose_frames(seen) if is_film else seen, folder / "images")
        names = _thinned(folder / "images", sorted(time_s))
        if len(names) < _FEWEST_FRAMES:
            raise InputError(
                f"{source}: shows {len(names)} frames that differ, of {_FEWEST_FRAMES} at least; {_ADVICE}"
            )
        placed = _place(source, folder, names, len(sizes) == 1, is_film, threads, seed, progress)
    if placed < max(_FEWEST_FRAMES, _LEAST_PLACED * len(names)):
        raise InputError(
            f"{source}: only {placed} of {len(names)} frames could be placed, less than {_LEAST_PLACED:.0%}; {_ADVICE}"
        )
    choices = {
        "frames": f"{len(names)} chosen of {progress.tasks[0].completed:.0f} by sharpness and movement"
        if is_film
        else f"all {len(names)} photographs",
        "matching": f"each with {_NEIGHBOURS} neighbours and farther ones" if is_film else "every pair",
        "registered": f"{placed} of {len(names)} frames ({placed / len(names):.0%})",
    }
    note = {"choices": choices, "time_s": {name: time_s[name] for name in names} if source.is_file() else {}}
    (folder / "note.json").write_text(json.dumps(note, indent=2), encoding="utf-8")


def _of_pictures(folder: Path) -> tuple[Iterator[SourceFrame], int]:
    """A folder's pictures in natural order, as frames."""
    paths = pictures(folder)
    return (SourceFrame(path.name, float(at), read_image(path)) for at, path in enumerate(paths)), len(paths)


def _write(frames: Iterable[SourceFrame], folder: Path) -> tuple[dict[str, float], set[tuple[int, ...]]]:
    """Write frames as JPEG; their times by name, and their sizes."""
    time_s, sizes = {}, set()
    for number, frame in enumerate(frames):
        name = f"{int(frame.name) if frame.name.isdecimal() else number:06d}.jpg"
        _, data = cv2.imencode(".jpg", frame.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        (folder / name).write_bytes(data.tobytes())
        time_s[name] = frame.time_s
        sizes.add(frame.image.shape[:2])
    return time_s, sizes


def _thinned(folder: Path, names: list[str]) -> list[str]:
    """Keep at most so many frames, evenly."""
    kept = [
        names[i] for i in np.unique(np.linspace(0, len(names) - 1, min(_MOST_FRAMES, len(names))).round().astype(int))
    ]
    for name in set(names) - set(kept):
        (folder / name).unlink()
    return kept


def _place(
    source: Path,
    folder: Path,
    names: list[str],
    one_camera: bool,
    is_film: bool,
    threads: int,
    seed: int,
    progress: Progress,
) -> int:
    """Reconstruct, and write the largest model to ``sparse/0``; how many images it places."""
    import pycolmap

    work, images = folder / "work", folder / "images"
    work.mkdir()
    mode = pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.PER_IMAGE
    features = pycolmap.FeatureExtractionOptions(num_threads=threads, max_image_size=_LONGEST_PX, use_gpu=False)
    features.sift.max_num_features = _FEATURES
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    mapping = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, extract_colors=False)
    database = work / "database.db"
    with _quiet(pycolmap), _in_one_line(source):
        pycolmap.set_random_seed(seed)
        progress.add_task("Finding features", total=None)
        pycolmap.extract_features(database, images, names, mode, extraction_options=features)
        progress.add_task("Matching frames", total=None)
        if is_film:
            pairing = pycolmap.SequentialPairingOptions(overlap=_NEIGHBOURS, quadratic_overlap=True)
            pycolmap.match_sequential(database, matching, pairing, verification)
        else:
            pycolmap.match_exhaustive(database, matching, verification_options=verification)
        advance = _advancing(progress, "Placing frames", len(names))
        models = pycolmap.incremental_mapping(
            database, images, work, mapping, initial_image_pair_callback=advance, next_image_callback=advance
        )
    largest: Any = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if largest is None:
        return 0
    (folder / "sparse" / "0").mkdir(parents=True)
    largest.write_binary(folder / "sparse" / "0")
    shutil.rmtree(work)
    return int(largest.num_reg_images())


def _advancing(progress: Progress, what: str, total: int) -> Callable[[], None]:
    task = progress.add_task(what, total=total)
    return lambda: progress.advance(task)


@contextmanager
def _quiet(pycolmap: Any) -> Iterator[None]:
    """Keep COLMAP's log to itself."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


@contextmanager
def _in_one_line(source: Path) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError) as error:  # what pycolmap makes of C++'s
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise InputError(f"{source}: COLMAP stopped ({reason[:200]}); {_ADVICE}") from None
