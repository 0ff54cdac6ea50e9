"""Bags as robots record them, written by rosbags: what tests read back."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

KINDS = ("bag", "db3", "mcap")
TF = "tf2_msgs/msg/TFMessage"
FIRST_NS = 1_700_000_000_123_456_789


class Recorder:
    """Messages of one ROS version, and the bag that they go into."""

    def __init__(self, kind: str, bag: Any) -> None:
        self.is_1, self.bag = kind == "bag", bag
        self.types = get_typestore(Stores.ROS1_NOETIC if self.is_1 else Stores.ROS2_HUMBLE)
        if self.is_1:  # tf2_msgs is not one of rosbags' own there
            self.types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        self.connections: dict[str, Any] = {}

    def make(self, name: str, **fields: Any) -> Any:
        """A message, whose fields are capitals where ROS 1 has them so."""
        of = self.types.types[name]
        known = of.__dataclass_fields__
        return of(**{key if key in known else key.upper(): value for key, value in fields.items()})

    def header(self, ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        more = {"seq": 0} if self.is_1 else {}
        return self.make("std_msgs/msg/Header", **more, stamp=stamp, frame_id=frame)

    def write(self, topic: str, name: str, message: Any, ns: int) -> None:
        """Record a message a tenth of a second late, as a busy robot does."""
        if topic not in self.connections:
            self.connections[topic] = self.bag.add_connection(topic, name, typestore=self.types)
        serialize = self.types.serialize_ros1 if self.is_1 else self.types.serialize_cdr
        self.bag.write(self.connections[topic], ns + 10**8, serialize(message, name))

    def image(self, topic: str, ns: int, frame: str, pixels: np.ndarray, encoding: str = "rgb8", pad: int = 0) -> None:
        """Raw, each row longer by some bytes."""
        rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, pad)))
        fields = {"height": len(pixels), "width": pixels.shape[1], "encoding": encoding, "is_bigendian": 0}
        data = np.frombuffer(rows.tobytes(), np.uint8)
        name, step = "sensor_msgs/msg/Image", rows.shape[1] * rows.itemsize
        message = self.make(name, header=self.header(ns, frame), **fields, step=step, data=data)
        self.write(topic, name, message, ns)

    def compressed(self, topic: str, ns: int, frame: str, file: bytes, of: str = "rgb8; jpeg compressed bgr8") -> None:
        name = "sensor_msgs/msg/CompressedImage"
        data = np.frombuffer(file, np.uint8)
        self.write(topic, name, self.make(name, header=self.header(ns, frame), format=of, data=data), ns)

    def camera(self, topic: str, ns: int, frame: str, size: tuple[int, int], matrix: np.ndarray, **told: Any) -> None:
        """``CameraInfo``; told: ``d``, ``distortion_model``, ``p``, ``binning``, ``roi`` (x, y, width, height)."""
        name, (x, y, width, height) = "sensor_msgs/msg/CameraInfo", told.get("roi", (0, 0, 0, 0))
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=x, y_offset=y, width=width, height=height, do_rectify=False
        )
        message = self.make(
            name,
            header=self.header(ns, frame),
            width=size[0],
            height=size[1],
            distortion_model=told.get("distortion_model", "plumb_bob"),
            d=np.array(told.get("d", []), float),
            k=np.asarray(matrix, float).ravel(),
            r=np.eye(3).ravel(),
            p=np.asarray(told.get("p", np.column_stack((matrix, np.zeros(3)))), float).ravel(),
            binning_x=told.get("binning", 0),
            binning_y=told.get("binning", 0),
            roi=region,
        )
        self.write(topic, name, message, ns)

    def _parts(self, pose: np.ndarray, position: str) -> tuple[Any, Any]:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        at = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
        return self.make(position, **at), self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, pose: np.ndarray) -> Any:
        position, orientation = self._parts(pose, "geometry_msgs/msg/Point")
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=orientation)

    def odometry(self, topic: str, ns: int, world: str, child: str, pose: np.ndarray) -> None:
        name, zero = "nav_msgs/msg/Odometry", self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        with_covariance = self.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=self.pose(pose), covariance=np.zeros(36)
        )
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        moving = self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
        fields = {"header": self.header(ns, world), "child_frame_id": child, "pose": with_covariance, "twist": moving}
        self.write(topic, name, self.make(name, **fields), ns)

    def pose_stamped(self, topic: str, ns: int, world: str, pose: np.ndarray) -> None:
        name = "geometry_msgs/msg/PoseStamped"
        self.write(topic, name, self.make(name, header=self.header(ns, world), pose=self.pose(pose)), ns)

    def transform(self, ns: int, parent: str, child: str, pose: np.ndarray, topic: str = "/tf") -> None:
        translation, rotation = self._parts(pose, "geometry_msgs/msg/Vector3")
        moved = self.make("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)
        name, header = "geometry_msgs/msg/TransformStamped", self.header(ns, parent)
        sent = self.make(name, header=header, child_frame_id=child, transform=moved)
        self.write(topic, TF, self.make(TF, transforms=[sent]), ns)


@contextmanager
def recorder(path: Path, kind: str):
    """Record a bag of a kind: ``path`` is a file of ROS 1, or a folder of ROS 2."""
    if kind == "bag":
        writer = rosbag1.Writer(path)
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
        writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
    with writer as bag:
        yield Recorder(kind, bag)


def recording_in(folder: Path):
    """Records with a function of a :class:`Recorder`, in a kind of bag, and gives the path."""

    def record(write, kind="mcap"):
        path = folder / f"drive.{kind}" if kind == "bag" else folder / "drive"
        with recorder(path, kind) as bag:
            write(bag)
        return path

    return record


def png(rgb: np.ndarray) -> bytes:
    return cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()


def messages(path: Path, topic: str) -> list[Any]:
    """All of a topic, read by rosbags."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        connections = [each for each in reader.connections if each.topic == topic]
        return [reader.deserialize(data, of.msgtype) for of, _, data in reader.messages(connections)]
