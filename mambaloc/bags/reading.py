"""A ROS bag's messages, one after another: ROS 1 ``.bag``, and ROS 2 in SQLite (``.db3``) and MCAP, by rosbags.

Times are those of the messages' headers, in nanoseconds: when an image was taken, not when it was recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from mambaloc.errors import InputError

_FILES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_HEAD_BYTES = 256
_FORGOTTEN = "Give the bag as it was recorded; 'rosbag reindex' or 'ros2 bag reindex' repairs one whose end is missing."

T = TypeVar("T")


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag, a ROS 2 bag's folder, or a single file of one, by its name."""
    if path.is_dir():
        return _is_metadata(path / _METADATA)
    return path.suffix in _FILES and path.is_file()


def _is_metadata(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return b"rosbag2_bagfile_information" in file.read(_HEAD_BYTES)
    except OSError:
        return False


def import_rosbags(path: Path) -> None:
    """Check that rosbags is there.

    Args:
        path: that it is needed for, for the message.

    Raises:
        InputError: where it is missing.
    """
    try:
        import rosbags.highlevel  # only here: an extra  # noqa: F401
    except ImportError:
        raise InputError(f"{path}: a ROS bag needs rosbags. Run pip install 'mambaloc[ros]'.") from None


class Bag:
    """An open bag.

    Args:
        path: of the bag, for messages.
        reader: rosbags' ``AnyReader``, open.
    """

    def __init__(self, path: Path, reader: Any) -> None:
        self.path = path
        self._reader = reader
        counts: dict[str, int] = {}
        for each in reader.connections:
            counts[each.topic] = counts.get(each.topic, 0) + each.msgcount
        self.topics = {each.topic: each.msgtype for each in reader.connections if counts[each.topic]}
        """Types of messages, by topic; topics without a message are left out."""
        self.counts = {topic: counts[topic] for topic in self.topics}
        """How many messages there are, by topic."""

    def of_types(self, types: Collection[str]) -> list[str]:
        """Topics of any of some types, in order of their names."""
        return sorted(topic for topic, of in self.topics.items() if of in types)

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, Any]]:
        """Messages of some topics with their topic's name, one at a time, in the order in which they were recorded.

        Raises:
            InputError: where the bag is damaged.
        """
        connections = [each for each in self._reader.connections if each.topic in topics]
        if not connections:  # rosbags would give all
            return
        stream = self._read(lambda: self._reader.messages(connections))
        while (found := self._read(lambda: next(stream, None))) is not None:
            connection, _, data = found
            yield connection.topic, self._read(self._reader.deserialize, data, connection.msgtype)

    def first(self, topic: str) -> Any:
        """A topic's first message.

        Raises:
            InputError: where the bag is damaged.
        """
        for _, message in self.messages([topic]):
            return message
        raise InputError(
            f"{self.path}: cannot be read ({self.counts[topic]} messages of {topic} are missing). {_FORGOTTEN}"
        )

    def _read(self, read: Callable[..., T], *arguments: Any) -> T:
        return _read(self.path, read, *arguments)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag.

    Args:
        path: as :func:`is_bag` takes it.

    Raises:
        InputError: without rosbags, or where the bag cannot be read.
    """
    import_rosbags(path)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    # Bags before ROS 2 Iron have no definitions; those of the messages read here are the same in every distribution.
    reader = _read(path, lambda: AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)))
    _read(path, reader.open)
    try:
        yield Bag(path, reader)
    finally:
        reader.close()


def _read(path: Path, read: Callable[..., T], *arguments: Any) -> T:
    """Call rosbags, which answers a damaged file with errors of many kinds."""
    try:
        return read(*arguments)
    except Exception as error:
        message = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: cannot be read ({type(error).__name__}: {message}). {_FORGOTTEN}") from None


def nanoseconds(header: Any) -> int:
    """The time of a message's header."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def frame_name(name: str) -> str:
    """A coordinate frame's name; ROS 1 may begin it with a slash."""
    return name.strip().lstrip("/")
