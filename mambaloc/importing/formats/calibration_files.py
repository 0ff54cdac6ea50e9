"""Calibration files of the layout of DSAC* and ACE, in which Wayspots are: ``calibration/X.txt`` beside ``rgb/X.jpg``.

A file has a focal length in pixels, with the principal point in the image's middle, or a 3x3 matrix. Files and
images belong together in their order. Pixels count from the image's corner: the loader scales the principal point as
it does the focal length. Source: ``dataset.py`` of github.com/nianticlabs/ace (Brachmann et al. 2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX, list_images
from mambaloc.importing.capture import Camera
from mambaloc.importing.formats.builder import pinhole
from mambaloc.importing.formats.nerfstudio_cameras import first_size
from mambaloc.importing.formats.parsing import as_numbers, read_text
from mambaloc.text import natural

_FOLDER = "calibration"


def calibrated(source: Path, images: Sequence[Path]) -> tuple[dict[Path, Camera], str]:
    """The camera of each image, by the files of the folder beside the images', and what was decided.

    Args:
        source: the capture's folder, outside of which nothing is read.
        images: all there.

    Returns:
        Cameras by image and an empty message; or no cameras and why, if there are files that do not fit.

    Raises:
        InputError: for a file that is malformed, or numbers that no camera has.
    """
    cameras: dict[Path, Camera] = {}
    for folder in dict.fromkeys(image.parent for image in images):
        calibrations = folder.parent / _FOLDER
        if folder == source or not calibrations.is_dir():
            return {}, ""
        files, beside = sorted(calibrations.glob("*.txt"), key=natural), list_images(folder)
        if len(files) != len(beside):
            return {}, f"none: {calibrations} has {len(files)} files, and {folder} {len(beside)} images"
        size = first_size(beside)
        cameras |= {image: _camera(file, size) for image, file in zip(beside, files, strict=True)}
    return cameras, ""


def _camera(file: Path, size: tuple[int, int]) -> Camera:
    values = as_numbers(read_text(file, "a focal length, or a 3x3 matrix").split())
    if values is None or len(values) not in (1, 9) or not np.isfinite(values).all():
        raise InputError(f"{file}: is neither a focal length nor a 3x3 matrix of numbers; correct it")
    fx, fy, cx, cy = values[[0, 4, 2, 5]] if len(values) == 9 else (*values, *values, size[0] / 2, size[1] / 2)
    return pinhole(size, (fx, fy), (cx - CORNER_PX, cy - CORNER_PX), file)
