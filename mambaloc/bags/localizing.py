"""Localize a bag's images, and write their poses into another bag."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console
from rich.progress import track

from mambaloc.bags.images import BagCamera, BagImage, camera_of, image_topic, images_of
from mambaloc.bags.reading import Bag, open_bag
from mambaloc.bags.transforms import Chain, Gap, Matrix, Transforms, along
from mambaloc.bags.writing import covariance_of, moved, pose_bag
from mambaloc.errors import InputError, InputWarning
from mambaloc.images import Image
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.localizer import Localizer
from mambaloc.runtime.video import VideoResult, summarize

Straightener = Callable[[BagCamera, tuple[int, int]], tuple[Matrix, Callable[[Image], Image]]]
"""Of a camera and an image's size: intrinsics of images as the scene has them, and what makes an image so."""

_REMEDY = "Give images of the place, and a model that states radii or has a map of it."


def localize_bag(
    localizer: Localizer,
    source: Path,
    out: Path,
    straightener: Straightener,
    topic: str | None = None,
    intrinsics: ArrayLike | None = None,
    world: str | None = None,
    frame: str | None = None,
    on_image: Callable[[BagImage, Image, ArrayLike | None, Localization], None] | None = None,
) -> VideoResult:
    """Localize every image of a bag, and write what a robot's filter takes: poses with covariances, at its times.

    A pose without radii says nothing to a filter, nor does that of an image that does not look like the place: these
    are left out with a warning, as are images that are damaged. Ctrl-C ends it; what was found is written then.

    Args:
        localizer: of the model.
        source: the bag.
        out: the bag to write, as :func:`~mambaloc.bags.writing.pose_bag` takes it.
        straightener: removes the distortion that the bag's ``CameraInfo`` has.
        topic: of the images; the only one unless given.
        intrinsics: of every image, (3, 3) in pixels; those of ``CameraInfo`` unless given.
        world: the name of the scene's frame in messages; unless given, ``map``, or the name of the recognised scene if
            the network knows several.
        frame: whose poses to write, through the bag's transforms; the camera's optical frame unless given.
        on_image: is given each image, it without distortion, its intrinsics, and what was found of it.

    Raises:
        InputError: where a bag cannot be read or written, an image cannot be localized, or none has a pose to write.
    """
    found: list[Localization] = []
    left_out, written = Counter[str](), 0
    with open_bag(source) as bag, pose_bag(out) as write:
        topic = image_topic(bag, topic)
        body_of = _body_of(bag, frame)
        bag_images = _straight(bag, topic, straightener, intrinsics, left_out)
        console = Console(stderr=True)
        try:
            for bag_image, image, matrix in track(
                bag_images, "Localizing", bag.counts[topic], console=console, transient=True
            ):
                found.append(localizer.localize(image, matrix))
                if on_image is not None:
                    on_image(bag_image, image, matrix, found[-1])
                stated = _stated(found[-1], body_of(bag_image))
                if isinstance(stated, str):
                    left_out[stated] += 1
                else:
                    write(bag_image.ns, world or found[-1].scene or "map", *stated)
                    written += 1
        except KeyboardInterrupt:
            pass
        reasons = "; ".join(f"{count} {why}" for why, count in left_out.items())
        if not written:
            raise InputError(f"{source}: no image of {topic} has a pose to write ({reasons}). {_REMEDY}")
    if reasons:
        warnings.warn(f"{out}: leaves out {reasons}.", InputWarning, stacklevel=2)
    return summarize(localizer, found)


def _stated(pose: Localization, cam_from_body: Matrix | Gap) -> tuple[Matrix, Matrix, Matrix] | str:
    """Position, quaternion and covariance of a body, or why a filter should not have them."""
    covariance = covariance_of(pose)
    if pose.source is None:
        return "without a pose"
    if pose.is_unfamiliar:
        return "that do not look like the place"
    if covariance is None:
        return "without radii"
    if isinstance(cam_from_body, Gap):
        return f"without a transform to {cam_from_body.link.child}"
    return moved(np.asarray(pose.position_m), np.asarray(pose.quaternion), covariance, cam_from_body)


def _body_of(bag: Bag, frame: str | None) -> Callable[[BagImage], Matrix | Gap]:
    """What gives ``cam_from_body`` (4, 4) at an image's time."""
    if frame is None:
        return lambda bag_image: np.eye(4)
    transforms, paths = Transforms(bag), dict[str, Chain]()

    def at(bag_image: BagImage) -> Matrix | Gap:
        if bag_image.frame not in paths:
            paths[bag_image.frame] = transforms.path(bag_image.frame, frame)
        return along(paths[bag_image.frame], bag_image.ns)

    return at


def _straight(
    bag: Bag, topic: str, straightener: Straightener, intrinsics: ArrayLike | None, left_out: Counter[str]
) -> Iterator[tuple[BagImage, Image, ArrayLike | None]]:
    """A topic's whole images as the scene has them, with their intrinsics; None where nothing says them."""
    camera = None if intrinsics is not None else camera_of(bag, topic)
    made: dict[tuple[int, int], tuple[Matrix, Callable[[Image], Image]]] = {}
    for bag_image in images_of(bag, topic):
        if isinstance(bag_image.image, str):
            left_out["that are damaged"] += 1
            continue
        if camera is None:
            yield bag_image, bag_image.image, intrinsics
            continue
        size = bag_image.image.shape[1], bag_image.image.shape[0]
        if size not in made:
            made[size] = straightener(camera, size)
        matrix, straighten = made[size]
        yield bag_image, straighten(bag_image.image), matrix
