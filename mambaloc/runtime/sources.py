"""Frames one after another: of a video, a folder of images, or a camera."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2

from mambaloc.errors import InputError, InputWarning
from mambaloc.images import IMAGE_SUFFIXES, Counts, Image, is_image, list_images, read_image
from mambaloc.renamed import renamed_arguments
from mambaloc.runtime.mp4 import read_about

IMAGES_HZ = 30.0
"""The rate at which a folder's images are taken to follow one another, as their files do not say it."""


@dataclass(frozen=True)
class SourceFrame:
    """One frame of a source.

    Args:
        name: file, or number in the video.
        time_s: seconds since the first frame.
        image: RGB, (H, W, 3).
    """

    name: str
    time_s: float
    image: Image


@renamed_arguments(pictures_hz="images_hz")
def frames_of(
    source: str | Path, images_hz: float = IMAGES_HZ, counts: Counts | None = None, is_upright: bool = True
) -> tuple[Iterator[SourceFrame], int | None]:
    """Open a source; return its frames, and about how many there are where that is known.

    A video's number is what its file says, less what it is trimmed by; those that are read may be fewer. A video with a
    high dynamic range is an :class:`~mambaloc.errors.InputWarning`.

    Args:
        source: a video file, an image, a folder of images (in natural order of their names), or the number of a
            camera, where no file or folder has that name.
        images_hz: frames per second of a folder of images; a video and a camera have their own times.
        counts: black and white of 16-bit images, as :func:`~mambaloc.images.read_image` takes them.
        is_upright: turn a video's frames as the video asks; otherwise they are as it stores them.

    Raises:
        InputError: where there is no such source, it is empty, or ``images_hz`` is not positive.
    """
    if not 0 < images_hz < math.inf:
        raise InputError(f"images_hz={images_hz}: must be a positive number of frames per second; correct it")
    path = Path(source)
    if path.is_dir():
        paths = list_images(path)
        if not paths:
            raise InputError(
                f"{path}: contains no image ({', '.join(IMAGE_SUFFIXES)}); give a folder of images or a video"
            )
        return _of_images(paths, images_hz, counts), len(paths)
    if not path.is_file():
        if str(source).isdecimal():
            return _of_capture(_opened(int(str(source)), f"camera {source}"), live=True), None
        raise InputError(f"{path}: no such file, folder or camera; a camera is a number, as 0")
    if is_image(path):  # else FFmpeg would take one tile of a phone's HEIC for a video
        return _of_images([path], images_hz, counts), 1
    capture = _opened(str(path), str(path))
    if not is_upright:
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    about = read_about(path)
    if about.hdr:
        warnings.warn(
            f"{path}: is a video with a high dynamic range ({about.hdr}), whose frames look flat beside other images. "
            "Record with HDR off, or convert it to SDR, and use such videos alone for training and localizing.",
            InputWarning,
            stacklevel=2,
        )
    count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    if about.shown_s is not None:  # a trimmed video counts frames that it does not show
        count = min(count, round(about.shown_s * capture.get(cv2.CAP_PROP_FPS)))
    return _of_capture(capture), count if count > 0 else None


def _of_images(paths: list[Path], rate_hz: float, counts: Counts | None) -> Iterator[SourceFrame]:
    for number, path in enumerate(paths):
        yield SourceFrame(path.name, number / rate_hz, read_image(path, counts))


def _opened(what: str | int, name: str) -> cv2.VideoCapture:
    remedy = "give a video that FFmpeg reads" if isinstance(what, str) else "is it plugged in? The first one is 0"
    try:
        capture = cv2.VideoCapture(what)
    except cv2.error:  # a number that no camera can have
        raise InputError(f"{name}: cannot be opened; {remedy}") from None
    if not capture.isOpened():
        raise InputError(f"{name}: cannot be opened; {remedy}")
    return capture


def _of_capture(capture: cv2.VideoCapture, live: bool = False) -> Iterator[SourceFrame]:
    """Frames with times that always grow; a camera's are the clock's, as few cameras state theirs."""
    rate_hz = capture.get(cv2.CAP_PROP_FPS)
    frame_s = 1 / rate_hz if rate_hz > 0 else 1 / 30
    began_s, time_s = 0.0, -frame_s
    try:
        for number in itertools.count():
            read, image = capture.read()
            if not read:
                break
            stamp_s = time.monotonic() if live else capture.get(cv2.CAP_PROP_POS_MSEC) / 1000  # of the frame just read
            began_s = began_s if number else stamp_s
            # Some streams have no stamps, and where videos were joined they may start again.
            time_s = stamp_s - began_s if stamp_s - began_s > time_s else time_s + frame_s
            yield SourceFrame(str(number), time_s, image[..., ::-1])  # type: ignore[arg-type]
    finally:
        capture.release()
