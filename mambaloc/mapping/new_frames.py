"""Frames to add to a map: of a scene with poses, of a folder of images, or of a video."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mambaloc.console import progress
from mambaloc.data.datasets.capture import is_captured
from mambaloc.errors import InputError
from mambaloc.images import read_image
from mambaloc.mapping.growing import NewFrame
from mambaloc.mapping.posed import read_frames
from mambaloc.mapping.recipe import recipe_of
from mambaloc.runtime.maps import CameraPose, MapLocalizer
from mambaloc.runtime.sources import frames_of

_MAX_FRAMES = 400  # of a video; two a second of three minutes
_FOCAL_SCALES = (0.7, 0.84, 1.0, 1.2, 1.44)
_FOCAL_FRAMES = 8
_CLEARLY_MORE = 1.3


def read_new_frames(
    source: Path,
    localizer: MapLocalizer,
    intrinsics: NDArray[np.float64] | None = None,
    is_distorted: bool = False,
) -> list[NewFrame]:
    """Read frames and find their keypoints.

    Args:
        source: an imported scene's folder or a recipe, whose training frames have poses and cameras; a folder of
            images, or a video, of which up to 400 frames are read.
        localizer: in the map that they are for.
        intrinsics: (3, 3) of the images; the map's camera unless given.
        is_distorted: images are as the map's camera stores them, and are undistorted by its lens.

    Raises:
        InputError: for what cannot be read; distorted images, where the map knows no lens or they have another shape
            than its; images of another shape than the map's without intrinsics; and images that clearly fit another
            focal length than the map's.
    """
    if source.suffix in (".yaml", ".yml") or (source.is_dir() and is_captured(source)):
        if intrinsics is not None:
            raise InputError(f"{source}: has intrinsics of its own. Leave out --intrinsics.")
        if is_distorted:
            raise InputError(f"{source}: a scene's images have no distortion. Leave out --distorted.")
        return list(_posed(source, localizer))
    frames = list(_unposed(source, localizer, intrinsics, is_distorted))
    if intrinsics is None:
        remedy = "Give them without distortion, and their camera" if is_distorted else "Give their camera"
        _check_focal_length(source, localizer, frames, remedy)
    return frames


def _posed(source: Path, localizer: MapLocalizer) -> Iterator[NewFrame]:
    frames = read_frames(recipe_of(source), "train")
    for image, intrinsics, pose in progress(
        zip(frames.images, frames.intrinsics, frames.world_from_cam, strict=True), "keypoints", len(frames)
    ):
        features = localizer.features(read_image(image) if isinstance(image, Path) else image, intrinsics)
        yield NewFrame(Path(str(image)).name, features, CameraPose(pose[:3, :3], pose[:3, 3]))


def _unposed(
    source: Path, localizer: MapLocalizer, intrinsics: NDArray[np.float64] | None, is_distorted: bool
) -> Iterator[NewFrame]:
    frames, count = frames_of(source)
    if count is None:  # some videos do not say; they are decoded twice
        count = sum(1 for _ in frames)
        frames = frames_of(source)[0]
    step = max(1, -(-count // _MAX_FRAMES))
    chosen = itertools.islice(frames, 0, None, step)
    for frame in progress(chosen, "keypoints", -(-count // step)):
        image, matrix = frame.image, intrinsics
        if is_distorted:
            image, matrix = localizer.map.undistortion.apply(image, str(source))
        yield NewFrame(frame.name, localizer.features(image, matrix))


def _check_focal_length(source: Path, localizer: MapLocalizer, frames: Sequence[NewFrame], remedy: str) -> None:
    """Refuse images of another camera of the same shape, which would bend what they add."""
    some = [frames[row] for row in np.unique(np.linspace(0, len(frames) - 1, _FOCAL_FRAMES).round().astype(int))]
    inliers = {}
    for scale in _FOCAL_SCALES:
        zoom = np.diag((scale, scale, 1))
        zoom[:2, 2] = (1 - scale) * some[0].features.intrinsics[:2, 2]
        zoomed = [replace(frame.features, intrinsics=zoom @ frame.features.intrinsics) for frame in some]
        found = [localizer.localize_features(features) for features in zoomed]
        inliers[scale] = sum(each.inliers for each in found if each.is_accepted)
    best = max(inliers, key=lambda scale: inliers[scale])
    if inliers[best] > _CLEARLY_MORE * inliers[1.0]:
        raise InputError(
            f"{source}: its images fit a focal length about {best:g} times the map's. "
            f"{remedy}: --intrinsics FX,FY,CX,CY."
        )
