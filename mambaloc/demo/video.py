"""A short video of the embedded scene, taken along a way that no training frame is on, with its true poses."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from mambaloc.errors import InputError
from mambaloc.rendering import GENERATOR_VERSION, default_intrinsics, embedded_room, embedded_walk, render, sensor
from mambaloc.runtime.rotations import quaternion_from_matrix
from mambaloc.user_cache import cached_folder

VIDEO_FILE, POSES_FILE = "film.webm", "film.json"
_FRAMES, _FPS, _SEED = 240, 15, 7
_SIZE = (320, 240)


def embedded_video() -> Path:
    """The folder of ``film.webm`` and ``film.json``, rendered into the user's cache on first use (half a minute).

    ``film.json`` holds ``file``, ``fps`` and ``poses``, x y z qw qx qy qz a frame: ``world_from_cam``, wxyz.

    Raises:
        InputError: where the cache cannot be written, or OpenCV came without VP8.
    """
    return cached_folder(f"films/embedded-{GENERATOR_VERSION}", _take)


def _take(folder: Path) -> None:
    room, intrinsics, rng = embedded_room(), default_intrinsics(_SIZE), np.random.default_rng(_SEED)
    walk = embedded_walk(_FRAMES, _SEED, start_deg=135.0, step_deg=1.2)
    # VP8: nearly every browser plays it, and OpenCV's wheels hold its encoder.
    with _quiet():
        writer = cv2.VideoWriter(str(folder / VIDEO_FILE), cv2.VideoWriter.fourcc(*"VP80"), _FPS, _SIZE)
    if not writer.isOpened():
        raise InputError(f"{VIDEO_FILE}: this OpenCV writes no VP8; install opencv-python-headless, or give --video")
    for world_from_cam in track(walk, "filming the embedded scene", console=Console(stderr=True), transient=True):
        rgb, _ = render(room, intrinsics, world_from_cam, _SIZE)
        writer.write(cv2.cvtColor(sensor(rgb, rng), cv2.COLOR_RGB2BGR))
    writer.release()
    if (taken := int(cv2.VideoCapture(str(folder / VIDEO_FILE)).get(cv2.CAP_PROP_FRAME_COUNT))) != _FRAMES:
        raise InputError(f"{folder.parent}: only {taken} of {_FRAMES} video frames were written. Free some disk space.")
    poses = [[*pose[:3, 3], *quaternion_from_matrix(pose[:3, :3])] for pose in walk]
    content = {"file": VIDEO_FILE, "fps": _FPS, "poses": np.round(poses, 5).tolist()}
    (folder / POSES_FILE).write_text(json.dumps(content) + "\n", encoding="utf-8")


@contextmanager
def _quiet() -> Iterator[None]:
    """OpenCV writes past Python, on the process's own stderr, that WebM names its codecs otherwise."""
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123  # no path of a file
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
