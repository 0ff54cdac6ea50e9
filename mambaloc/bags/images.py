"""Images of a bag: ``sensor_msgs/Image`` and ``CompressedImage``, with the camera that ``CameraInfo`` describes.

Encodings are those of ``sensor_msgs/image_encodings.hpp``. Compressed images are files of JPEG or PNG. Intrinsics are
OpenCV's: the centre of the top-left pixel is (0, 0), and distortion models are ``plumb_bob``, ``rational_polynomial``
and ``equidistant`` (``sensor_msgs/distortion_models.hpp``). A rectified topic has the projection matrix P instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.bags.reading import Bag, frame_name, nanoseconds
from mambaloc.errors import InputError
from mambaloc.images import CORNER_PX, Image, decode_image

RAW, COMPRESSED, CAMERA = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))

_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3, "8UC4": 4}
_CHANNELS |= {"uyvy": 2, "yuv422": 2, "yuyv": 2, "yuv422_yuy2": 2}
_CHANNELS |= {f"bayer_{pattern}8": 1 for pattern in ("rggb", "bggr", "gbrg", "grbg")}
_TO_RGB = {
    **dict.fromkeys(("mono8", "8UC1"), cv2.COLOR_GRAY2RGB),
    **dict.fromkeys(("bgr8", "8UC3"), cv2.COLOR_BGR2RGB),  # OpenCV's order, where none is stated
    **dict.fromkeys(("bgra8", "8UC4"), cv2.COLOR_BGRA2RGB),
    "rgba8": cv2.COLOR_RGBA2RGB,
    **dict.fromkeys(("uyvy", "yuv422"), cv2.COLOR_YUV2RGB_UYVY),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), cv2.COLOR_YUV2RGB_YUY2),
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}
_DEPTH = ("16UC1", "32FC1")


@dataclass(frozen=True)
class BagImage:
    """A message with an image.

    Args:
        number: of the message in its topic, from 0.
        ns: when it was taken, in nanoseconds.
        frame: the camera's optical frame.
        image: RGB (H, W, 3); or, of an image that is damaged, the rule that it breaks.
        file: the image's JPEG or PNG; None where it was recorded raw.
    """

    number: int
    ns: int
    frame: str
    image: Image | str
    file: bytes | None = None


@dataclass(frozen=True)
class BagCamera:
    """What ``CameraInfo`` says of a camera, in pixels of its images.

    Args:
        size: width and height.
        matrix: (3, 3).
        model: of the distortion, as ROS names it.
        coefficients: of the distortion; none of a pinhole.
    """

    size: tuple[int, int]
    matrix: NDArray[np.float64]
    model: str
    coefficients: tuple[float, ...]


def image_topic(bag: Bag, asked: str | None = None) -> str:
    """The topic of a bag's images: the one there is, or the one of several that has a camera, unless one is named.

    Topics of depth images do not count.

    Raises:
        InputError: if no topic has that name, the bag has no topic of images, or it has several.
    """
    every = [topic for topic in bag.of_types((RAW, COMPRESSED)) if not _is_depth(bag, topic)]
    if asked is not None:
        if asked not in every:
            there = ", ".join(every) or "none"
            raise InputError(f"--topic {asked}: {bag.path} has no such topic of images. Choose one of {there}.")
        return asked
    if not every:
        raise InputError(f"{bag.path}: has no topic of images (Image or CompressedImage). Record the camera's.")
    known = [topic for topic in every if camera_topic(bag, topic) is not None]
    found = every if len(every) == 1 else known
    if len(found) != 1:
        raise InputError(f"{bag.path}: has images in {', '.join(every)}. Choose one with --topic NAME.")
    return found[0]


def _is_depth(bag: Bag, topic: str) -> bool:
    first = bag.first(topic)
    return "compressedDepth" in first.format if hasattr(first, "format") else first.encoding in _DEPTH


def camera_topic(bag: Bag, topic: str) -> str | None:
    """The topic of ``CameraInfo`` beside that of images, as ``image_transport`` names it; None without one."""
    base = topic.removesuffix("/compressed")
    name = f"{base.rpartition('/')[0]}/camera_info"
    return name if bag.topics.get(name) == CAMERA else None


def camera_of(bag: Bag, topic: str) -> BagCamera | None:
    """The camera of a topic's images; None where the bag does not have it.

    Raises:
        InputError: where it is not calibrated, or its distortion is of no known model.
    """
    name = camera_topic(bag, topic)
    if name is None:
        return None
    info, where = bag.first(name), f"{bag.path}: {name}"
    matrices = {key: _numbers(info, key) for key in "kpd"}
    is_rectified = "rect" in topic.removesuffix("/compressed").rpartition("/")[2]
    matrix = matrices["p"].reshape(3, 4)[:, :3] if is_rectified else matrices["k"].reshape(3, 3)
    if not np.isfinite(matrix).all() or not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise InputError(f"{where}: is not calibrated (focal length 0). Calibrate the camera, or leave its topic out.")
    matrix, size = matrix.copy(), (int(info.width), int(info.height))
    if info.roi.width and info.roi.height:
        matrix[:2, 2] -= (info.roi.x_offset, info.roi.y_offset)
        size = int(info.roi.width), int(info.roi.height)
    binning = np.maximum((info.binning_x, info.binning_y), 1).astype(float)
    matrix[:2, 2] = (matrix[:2, 2] + CORNER_PX) / binning - CORNER_PX
    matrix[(0, 1), (0, 1)] /= binning
    size = int(size[0] // binning[0]), int(size[1] // binning[1])
    coefficients = () if is_rectified else tuple(matrices["d"].tolist())
    return BagCamera(size, matrix, info.distortion_model, coefficients if any(coefficients) else ())


def _numbers(info: Any, name: str) -> NDArray[np.float64]:
    """A field that ROS 1 writes as a capital."""
    return np.asarray(getattr(info, name, None) if hasattr(info, name) else getattr(info, name.upper()), np.float64)


def images_of(bag: Bag, topic: str) -> Iterator[BagImage]:
    """A topic's images, one at a time, in the order in which they were recorded.

    Raises:
        InputError: for an encoding that is not read, images without a time, or of several frames.
    """
    frame = None
    for number, (_, message) in enumerate(bag.messages([topic])):
        ns, named = nanoseconds(message.header), frame_name(message.header.frame_id)
        frame = named if frame is None else frame
        if named != frame:
            raise InputError(
                f"{bag.path}: {topic} has images of the frames {frame!r} and {named!r}. Record one topic per camera."
            )
        if ns <= 0:
            raise InputError(f"{bag.path}: {topic}, message {number}: its header has no time. Record with time stamps.")
        if hasattr(message, "format"):
            data = message.data.tobytes()
            yield BagImage(number, ns, frame, decode_image(data, upright=False), data)
        else:
            yield BagImage(number, ns, frame, _decoded(message, f"{bag.path}: {topic}"))


def _decoded(message: Any, where: str) -> Image | str:
    """A raw image as RGB (H, W, 3), or the rule that it breaks."""
    encoding, height, width = message.encoding, int(message.height), int(message.width)
    if encoding not in _CHANNELS:
        remedy = "Record 8 bits (mono8, rgb8)." if "16" in encoding or "32" in encoding else "Record rgb8 or JPEG."
        raise InputError(f"{where}: has images encoded as {encoding!r}, which is not read. {remedy}")
    channels, step = _CHANNELS[encoding], int(message.step)
    if not (height and width and step >= width * channels and len(message.data) >= height * step):
        return f"image of {width}x{height} has {len(message.data)} bytes, less than it needs"
    rows = np.asarray(message.data, np.uint8)[: height * step].reshape(height, step)[:, : width * channels]
    pixels = np.ascontiguousarray(rows).reshape(height, width, channels)
    if encoding == "rgb8":
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, _TO_RGB[encoding]), np.uint8)
    except cv2.error:  # an odd width has no pairs of pixels
        return f"image of {width}x{height} cannot be encoded as {encoding}"
