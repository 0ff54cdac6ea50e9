"""Where a bag says that its camera was: a topic of poses, or ``/tf``, followed to the camera's optical frame."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from mambaloc.bags.reading import Bag, frame_name, nanoseconds
from mambaloc.bags.transforms import LONGEST_GAP_S, Chain, Gap, Link, Transforms
from mambaloc.errors import InputError

TF = "/tf"
"""Names the transforms as a source of poses."""

_ODOMETRY, _TRANSFORM = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"
_POSES = (
    _ODOMETRY,
    _TRANSFORM,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)


@dataclass(frozen=True)
class PoseSource:
    """What places a camera.

    Args:
        name: the topic.
        world: the frame that positions are in.
        path: from there to the camera's optical frame.
    """

    name: str
    world: str
    path: Chain

    @property
    def chain(self) -> str:
        """The chain of frames."""
        frames = [self.world]
        for link, is_upwards in self.path:
            frames.append(link.parent if is_upwards else link.child)
        return " -> ".join(frames)


def pose_source(bag: Bag, camera: str, asked: str | None = None, of: str | None = None) -> PoseSource:
    """Find what places a camera.

    Args:
        bag: that is read through.
        camera: its optical frame.
        asked: the topic, or :data:`TF`; the only one unless given.
        of: the frame whose poses the topic has, where its messages do not say that.

    Raises:
        InputError: if the bag has no poses, several topics with poses, or no transform leads from there to the camera.
    """
    transforms = Transforms(bag)
    topics = [*bag.of_types(_POSES), *([TF] if _moves(transforms, camera) else [])]
    named = f"its sources of poses: {', '.join(topics) or 'none'}"
    if asked is not None and asked not in topics:
        because = _still(transforms, camera) if asked == TF else "the bag has no poses there"
        raise InputError(f"--pose-topic {asked}: {because}; {bag.path} and {named}.")
    if not topics:
        raise InputError(
            f"{bag.path}: nothing says where the camera {camera!r} was: it has no Odometry, PoseStamped or "
            f"TransformStamped, and {_still(transforms, camera)}. Record such a topic with the images."
        )
    if asked is None and len(topics) > 1:
        raise InputError(f"{bag.path}: has poses in {', '.join(topics)}. Choose one with --pose-topic NAME.")
    topic = asked or topics[0]
    if topic == TF:
        world = transforms.root(camera)
        return PoseSource(TF, world, transforms.path(world, camera))
    link = _link(bag, topic, camera, of)
    return PoseSource(topic, link.parent, [(link, False), *transforms.path(link.child, camera)])


def _moves(transforms: Transforms, camera: str) -> bool:
    return any(not link.is_static for link, _ in transforms.path(transforms.root(camera), camera))


def _still(transforms: Transforms, camera: str) -> str:
    if not transforms.links:
        return "no transform (/tf)"
    return f"/tf does not move {camera!r} in {transforms.root(camera)!r}"


def _link(bag: Bag, topic: str, camera: str, of: str | None) -> Link:
    """A topic's poses."""
    link = None
    for _, message in bag.messages([topic]):
        parent, child_id = frame_name(message.header.frame_id), frame_name(getattr(message, "child_frame_id", ""))
        child = child_id or of
        if not child:
            raise InputError(
                f"{bag.path}: {topic} does not name the frame of its poses. Name it with --pose-frame: {camera} if "
                "they are the camera's (z forward), or the robot's, such as base_link."
            )
        link = link or Link(parent, child)
        if (parent, child) != (link.parent, link.child):
            raise InputError(
                f"{bag.path}: {topic} has poses of {link.child!r} in {link.parent!r} and of {child!r} in {parent!r}. "
                "Record a topic for each."
            )
        link.add(nanoseconds(message.header), *_parts(message))
    if link is None or not len(link):
        raise InputError(f"{bag.path}: {topic} has no pose with a rotation. Record it again.")
    return link


def _parts(message: Any) -> tuple[Any, Any]:
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return pose.position, pose.orientation


class Gaps:
    """Images that have no pose, counted by why."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.longest: dict[str, Gap] = {}

    def add(self, gap: Gap) -> None:
        """Count one."""
        name = f"{gap.link.parent} -> {gap.link.child}"
        if gap.length_s is None:
            self.counts[f"before the first or after the last of {name}"] += 1
            return
        why = f"in gaps of {name} over {LONGEST_GAP_S} s"
        self.counts[why] += 1
        if (longest := self.longest.get(why)) is None or gap.length_s > (longest.length_s or 0.0):
            self.longest[why] = gap

    def __str__(self) -> str:
        """How many there are, in a line; empty without any."""
        reasons = []
        for why, count in self.counts.items():
            gap = self.longest.get(why)
            longest = f", the longest of {gap.length_s:.2f} s around {gap.ns / 1e9:.2f} s" if gap else ""
            reasons.append(f"{count} {why}{longest}")
        return f"{sum(self.counts.values())} images have no pose: {'; '.join(reasons)}" if reasons else ""
