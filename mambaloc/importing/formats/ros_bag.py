"""Robots' recordings: ROS 1 bags (``.bag``) and ROS 2 bags (a folder, ``.mcap`` or ``.db3``), read by rosbags.

An image's time and its camera's optical frame are those of its message's header. That frame has OpenCV's axes, z
forward, x right and y down (REP 103). It is placed by a topic of poses or by ``/tf``, whose transforms are
interpolated at the image's time; ``/tf_static`` links the robot to the camera.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mambaloc.bags.images import BagCamera, BagImage, camera_of, image_topic, images_of
from mambaloc.bags.poses import Gaps, pose_source
from mambaloc.bags.reading import Bag, frame_name, open_bag
from mambaloc.bags.transforms import Gap, along
from mambaloc.errors import InputError, InputWarning
from mambaloc.images import Image
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.formats.builder import Pose, Posed, build_capture, pinhole
from mambaloc.importing.formats.parsing import folder_name
from mambaloc.importing.frame_choice import choose_frames
from mambaloc.importing.undistort.fitting import FittedCameras
from mambaloc.importing.video import digest_of
from mambaloc.runtime.camera_models import FisheyeModel, OpenCVModel
from mambaloc.runtime.sources import SourceFrame
from mambaloc.runtime.undistortion import undistorted
from mambaloc.user_cache import cached_folder

_VERSION = 1  # of what is kept; another one is made again
_NOTE, _POSES = "note.json", "poses.npy"
_LENSES = {
    "plumb_bob": (OpenCVModel, (4, 5)),
    "rational_polynomial": (OpenCVModel, (8, 12, 14)),
    "equidistant": (FisheyeModel, (4,)),
    "fisheye": (FisheyeModel, (4,)),
}
"""Models of distortion, and how many coefficients each may have."""


@dataclass(frozen=True)
class BagTopics:
    """What to read of a bag that has several.

    Args:
        images: the topic of images.
        poses: the topic of poses, or ``/tf``.
        pose_frame: the frame that the poses are of, where their messages do not say it.
    """

    images: str | None = None
    poses: str | None = None
    pose_frame: str | None = None


def read_ros_bag(source: Path, topics: BagTopics | None = None) -> Capture:
    """Choose images that have a pose for sharpness and movement; they are kept in the user's cache.

    Args:
        source: as :func:`~mambaloc.bags.reading.is_bag` takes it.
        topics: what to read; the only ones there are unless given.

    Raises:
        InputError: for a bag that cannot be read, that does not say where its camera was, or that has several topics of
            which none is named.
    """
    asked = topics or BagTopics()
    with open_bag(source) as bag:
        topic = image_topic(bag, asked.images)
        camera_info = camera_of(bag, topic)
        digest = digest_of(_files(source), _VERSION, topic, asked.poses, asked.pose_frame)
        folder = cached_folder(f"bags/{digest}", lambda partial: _write_chosen(bag, topic, asked, partial))
    note, poses = json.loads((folder / _NOTE).read_text(encoding="utf-8")), np.load(folder / _POSES)
    if note["gaps"]:
        warnings.warn(f"{source}: {note['gaps']}.", InputWarning, stacklevel=2)
    cameras = {} if camera_info is None else {"camera": camera_from(camera_info, f"{source}: CameraInfo of {topic}")}
    sequence = folder_name(source) if source.is_dir() else source.stem
    frames = sorted(zip(note["frames"], poses, strict=True), key=lambda frame: frame[0]["ns"])
    posed = [
        Posed(folder / each["name"], sequence, Pose(pose), next(iter(cameras), None), each["ns"] / 1e9)
        for each, pose in frames
    ]
    return build_capture(
        "ros_bag",
        source,
        posed,
        unit="metre",
        choices={
            "axes": f"OpenCV camera axes, which the optical frame {note['camera']} has (REP 103)",
            "direction": f"camera-to-world: {note['chain']}, by {note['poses']}",
            "scale": "metres (REP 103)",
            "origin": f"kept: that of {note['world']}",
            "times": "of the messages' headers; transforms interpolated there",
            "frames": f"{len(posed)} of {note['count']} in {topic}, by sharpness and movement",
            **({"gaps": note["gaps"]} if note["gaps"] else {}),
        },
        cameras=cameras,
        left_out={Path(name): rule for name, rule in note["damaged"].items()},
    )


def camera_from(camera_info: BagCamera, where: str) -> Camera:
    """A bag's camera with its lens.

    Args:
        camera_info: the camera of ``CameraInfo``.
        where: it is, for messages.

    Raises:
        InputError: for a distortion of no known model, or numbers that no lens has.
    """
    (fx, fy), (cx, cy) = camera_info.matrix[(0, 1), (0, 1)].tolist(), camera_info.matrix[:2, 2].tolist()
    camera = pinhole(camera_info.size, (fx, fy), (cx, cy), where)
    if not camera_info.coefficients:
        return camera
    lens, counts = _LENSES.get(camera_info.model, (OpenCVModel, ()))
    if len(camera_info.coefficients) not in counts:
        raise InputError(
            f"{where}: has the distortion model {camera_info.model!r} with {len(camera_info.coefficients)} "
            f"coefficients, which is not read ({', '.join(_LENSES)}). Record a rectified topic."
        )
    distorted = lens(camera.focal_px, camera.center_px, camera_info.coefficients)
    return Camera(camera.width, camera.height, camera.focal_px, camera.center_px, distorted, camera_info.model)


def straightener(camera_info: BagCamera, size: tuple[int, int]) -> tuple[NDArray[np.float64], Callable[[Image], Image]]:
    """Intrinsics (3, 3) of a bag's images of a size as an import writes them, and what makes an image so.

    Raises:
        InputError: for images of another shape than the camera's, or as :func:`camera_from`.
    """
    name = "CameraInfo"
    cameras = FittedCameras({name: camera_from(camera_info, name)})
    fit = cameras.fitted(name, size)
    if fit is None:
        shapes = " and ".join("{}x{}".format(*each) for each in (size, camera_info.size))
        raise InputError(f"{name}: images and camera have other shapes ({shapes}). Give these with --intrinsics.")
    used, maps = cameras.as_used([name], [size], {size: size})[1][name], fit[1]

    def straighten(image: Image) -> Image:
        return image if maps is None else undistorted(image, maps)

    return used.intrinsics, straighten


def _files(source: Path) -> list[Path]:
    return sorted(path for path in source.iterdir() if path.is_file()) if source.is_dir() else [source]


@dataclass(frozen=True)
class _PosedFrame(SourceFrame):
    bag_image: BagImage
    pose: NDArray[np.float64]


def _write_chosen(bag: Bag, topic: str, asked: BagTopics, folder: Path) -> None:
    """Write chosen images as they were recorded, raw ones as PNG, beside their poses and a note."""
    camera = frame_name(bag.first(topic).header.frame_id)
    source = pose_source(bag, camera, asked.poses, asked.pose_frame)
    gaps, damaged = Gaps(), dict[str, str]()

    def with_pose() -> Iterator[_PosedFrame]:
        seen = set()
        count, console = bag.counts[topic], Console(stderr=True)
        for bag_image in track(images_of(bag, topic), "Choosing frames", count, console=console, transient=True):
            pose = along(source.path, bag_image.ns)
            if isinstance(pose, Gap):
                gaps.add(pose)
            elif isinstance(bag_image.image, str):
                damaged[f"{topic}, message {bag_image.number}"] = bag_image.image
            elif bag_image.ns not in seen:  # else it was recorded twice
                seen.add(bag_image.ns)
                yield _PosedFrame(str(bag_image.number), bag_image.ns / 1e9, bag_image.image, bag_image, pose)

    frames, poses = [], []
    for frame in choose_frames(with_pose()):
        assert isinstance(frame, _PosedFrame)
        data, suffix = _file_of(frame.bag_image)
        name = f"{frame.bag_image.number:06d}{suffix}"
        (folder / name).write_bytes(data)
        frames.append({"name": name, "ns": frame.bag_image.ns})
        poses.append(frame.pose)
    if not frames:
        raise InputError(
            f"{bag.path}: no image of {topic} has a pose; {str(gaps) or 'none is whole'}. Record both at once."
        )
    np.save(folder / _POSES, np.array(poses))
    note = {
        "frames": frames,
        "count": bag.counts[topic],
        "camera": camera,
        "world": source.world,
        "chain": source.chain,
        "poses": source.name,
        "gaps": str(gaps),
        "damaged": damaged,
    }
    (folder / _NOTE).write_text(json.dumps(note), encoding="utf-8")


def _file_of(bag_image: BagImage) -> tuple[bytes, str]:
    """The image's file as it was recorded, or a PNG, and its suffix."""
    for start, suffix in ((b"\xff\xd8", ".jpg"), (b"\x89PNG", ".png")):
        if bag_image.file is not None and bag_image.file.startswith(start):
            return bag_image.file, suffix
    image: Any = bag_image.image
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes(), ".png"
