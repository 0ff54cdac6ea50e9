"""Poses as a ROS bag of ``geometry_msgs/PoseWithCovarianceStamped``, which a robot's filter takes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.bags.reading import import_rosbags
from mambaloc.errors import InputError
from mambaloc.files import atomic_file, atomic_folder, writing
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.maps.radii import covariance_radius
from mambaloc.runtime.rotations import matrix_from_quaternion, quaternion_from_matrix

Matrix = NDArray[np.float64]
WritePose = Callable[[int, str, Matrix, Matrix, Matrix], None]

TOPIC = "/mambaloc/pose"
_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"


@contextmanager
def pose_bag(out: Path) -> Iterator[WritePose]:
    """Make a bag, and give what writes a pose to it.

    That takes the time in nanoseconds, the name of the frame that the pose is in, position, quaternion wxyz and
    covariance (6, 6).

    Args:
        out: a ROS 1 bag where its name ends in ``.bag``, or the folder of a ROS 2 bag in MCAP. It is there whole once
            the block ends; an error leaves nothing.

    Raises:
        InputError: without rosbags, or where it is there already or cannot be written.
    """
    import_rosbags(out)
    from rosbags.typesys import Stores, get_typestore

    if out.exists():
        raise InputError(f"--out {out}: already exists. Remove it, or choose another --out.")
    is_1 = out.suffix == ".bag"
    types: Any = get_typestore(Stores.ROS1_NOETIC if is_1 else Stores.ROS2_HUMBLE)
    serialize = types.serialize_ros1 if is_1 else types.serialize_cdr
    with writing(out), _ros1_bag(out) if is_1 else _ros2_bag(out) as bag:
        connection = bag.add_connection(TOPIC, _TYPE, typestore=types)

        def write(ns: int, world: str, position: Matrix, quaternion: Matrix, covariance: Matrix) -> None:
            message = _message(types, world, ns, position, quaternion, covariance)
            bag.write(connection, ns, serialize(message, _TYPE))

        yield write


@contextmanager
def _ros1_bag(out: Path) -> Iterator[Any]:
    from rosbags.rosbag1 import Writer

    with atomic_file(out) as partial, Writer(partial) as bag:
        yield bag


@contextmanager
def _ros2_bag(out: Path) -> Iterator[Any]:
    from rosbags.rosbag2 import StoragePlugin, Writer

    with atomic_folder(out, "choose another folder with --out") as partial:
        named = partial / out.name  # rosbags makes a bag's folder itself, and names its file as that
        with Writer(named, version=8, storage_plugin=StoragePlugin.MCAP) as bag:  # 8 is read by older ROS 2, too
            yield bag
        for file in named.iterdir():
            file.replace(partial / file.name)
        named.rmdir()


def _message(types: Any, world: str, ns: int, position: Matrix, quaternion: Matrix, covariance: Matrix) -> Any:
    of = types.types
    stamp = of["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
    header = of["std_msgs/msg/Header"]
    w, x, y, z = map(float, quaternion)
    pose = of["geometry_msgs/msg/Pose"](
        of["geometry_msgs/msg/Point"](*map(float, position)), of["geometry_msgs/msg/Quaternion"](x, y, z, w)
    )
    with_covariance = of["geometry_msgs/msg/PoseWithCovariance"](pose, np.asarray(covariance, np.float64).ravel())
    ros1 = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}  # ROS 2 has none
    return of[_TYPE](header(**ros1, stamp=stamp, frame_id=world), with_covariance)


def covariance_of(pose: Localization) -> Matrix | None:
    """The covariance (6, 6) of a pose, in metres and radians about the world's axes, as ROS has it.

    The map's where it has one. Otherwise of a normal error, the same in every direction, that is within the radii as
    often as the model states. None where nothing says how far off the pose may be.
    """
    if pose.covariance is not None:
        return np.asarray(pose.covariance, np.float64)
    if pose.position_radius_m is None or pose.rotation_radius_deg is None:
        return None
    of_one = covariance_radius(np.eye(3))
    sigmas = np.repeat((pose.position_radius_m / of_one, np.radians(pose.rotation_radius_deg) / of_one), 3)
    return np.diag(sigmas**2)


def moved(
    position: Matrix, quaternion: Matrix, covariance: Matrix, cam_from_body: Matrix
) -> tuple[Matrix, Matrix, Matrix]:
    """The pose of another frame on the same body, and its covariance.

    A turn about the camera moves the body's origin, too: ``d body = d cam + d turn x arm``, where ``arm`` leads from
    the camera to the body, in the world's axes.

    Args:
        position: of the camera, (3,).
        quaternion: of the camera, wxyz.
        covariance: (6, 6), of the camera.
        cam_from_body: (4, 4).
    """
    rotation = matrix_from_quaternion(quaternion)
    arm = rotation @ cam_from_body[:3, 3]
    slopes = np.eye(6)
    slopes[:3, 3:] = [[0, arm[2], -arm[1]], [-arm[2], 0, arm[0]], [arm[1], -arm[0], 0]]
    turned = quaternion_from_matrix(rotation @ cam_from_body[:3, :3])
    return position + arm, turned, slopes @ covariance @ slopes.T
