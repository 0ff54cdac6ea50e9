"""Where a frame is at a time, from transforms that were sent at others: ``/tf`` and ``/tf_static`` (Foote 2013).

Positions are interpolated linearly, rotations along the shortest arc (Shoemake 1985), between the transforms before and
after. Where these are too far apart, or one is missing, the transform is unknown.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.bags.reading import Bag, frame_name, nanoseconds
from mambaloc.errors import InputError
from mambaloc.runtime.rotations import (
    matrix_from_quaternion,
    multiply,
    quaternion_from_rotation_vector,
    rotation_vector_between,
)

Matrix = NDArray[np.float64]

LONGEST_GAP_S = 0.5
"""Between transforms that are farther apart nothing is interpolated."""
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_UNIT = (0.5, 2.0)  # lengths of quaternions that are made units, as in other formats


@dataclass
class Link:
    """``parent_from_child`` over time.

    Args:
        parent: frame.
        child: frame.
        is_static: it holds for all times.
    """

    parent: str
    child: str
    is_static: bool = False
    _ns: array[int] = field(default_factory=lambda: array("q"))
    _values: array[float] = field(default_factory=lambda: array("d"))

    def add(self, ns: int, position: Any, quaternion: Any) -> None:
        """Add a transform, with fields ``x``, ``y``, ``z`` and ``w``; a mark of no fix is left out."""
        values = [position.x, position.y, position.z, quaternion.w, quaternion.x, quaternion.y, quaternion.z]
        length = float(np.linalg.norm(values[3:]))
        if np.isfinite(values).all() and _UNIT[0] <= length <= _UNIT[1]:
            self._ns.append(ns)
            self._values.extend(values)

    def __len__(self) -> int:
        return len(self._ns)

    @cached_property
    def _samples(self) -> tuple[NDArray[np.int64], Matrix]:
        """Times in order, once each, and rows of position and quaternion; asked for once all are added."""
        ns, last = np.unique(np.array(self._ns, np.int64)[::-1], return_index=True)  # the later one of two at one time
        return ns, np.array(self._values).reshape(-1, 7)[::-1][last]

    def at(self, ns: int) -> Matrix | Gap:
        """``parent_from_child`` (4, 4) at a time, or why it is unknown."""
        times, values = self._samples
        if self.is_static:
            return _matrix(values[-1, :3], values[-1, 3:])
        after = int(np.searchsorted(times, ns))
        if after < len(times) and times[after] == ns:
            return _matrix(values[after, :3], values[after, 3:])
        if after in (0, len(times)):
            return Gap(self, ns, None)
        before, gap_ns = after - 1, int(times[after] - times[after - 1])
        if gap_ns > LONGEST_GAP_S * 1e9:
            return Gap(self, ns, gap_ns / 1e9)
        share = float(ns - times[before]) / gap_ns
        position = (1 - share) * values[before, :3] + share * values[after, :3]
        first, second = (values[row, 3:] / np.linalg.norm(values[row, 3:]) for row in (before, after))
        turn = quaternion_from_rotation_vector(share * rotation_vector_between(first, second))
        return _matrix(position, multiply(first, turn))


@dataclass(frozen=True)
class Gap:
    """Where a link is not known.

    Args:
        link: which one.
        ns: when.
        length_s: between the transforms around it; None before the first and after the last.
    """

    link: Link
    ns: int
    length_s: float | None


Chain = Sequence[tuple[Link, bool]]
"""Links from a frame to another, and whether each is passed from its child to its parent."""


class Transforms:
    """The tree of frames of a bag's ``/tf`` and ``/tf_static``.

    Args:
        bag: that is read through.
    """

    def __init__(self, bag: Bag) -> None:
        self.bag = bag
        self.links: dict[str, Link] = {}
        self.parents: dict[str, set[str]] = {}
        for topic, message in bag.messages(bag.of_types(TRANSFORMS)):
            for each in message.transforms:
                self._add(each, topic.endswith("tf_static"))

    def _add(self, sent: Any, is_static: bool) -> None:
        parent, child = frame_name(sent.header.frame_id), frame_name(sent.child_frame_id)
        self.parents.setdefault(child, set()).add(parent)
        link = self.links.setdefault(child, Link(parent, child, is_static))
        link.is_static = link.is_static or is_static
        link.add(nanoseconds(sent.header), sent.transform.translation, sent.transform.rotation)

    def root(self, frame: str) -> str:
        """The frame that all others of a frame's tree are placed in."""
        return self._upwards(frame)[-1]

    def path(self, parent: str, child: str) -> Chain:
        """Links that lead to ``parent_from_child``.

        Raises:
            InputError: where none lead there.
        """
        above, below = self._upwards(parent), self._upwards(child)
        common = next((frame for frame in below if frame in above), None)
        if common is None:
            known = ", ".join(sorted({*self.links, *(link.parent for link in self.links.values())})) or "none"
            raise InputError(
                f"{self.bag.path}: no transform links the frames {parent!r} and {child!r}; /tf and /tf_static have "
                f"{known}. Record /tf_static with the bag, or add the transform between them."
            )
        up = [(self.links[frame], True) for frame in above[: above.index(common)]]
        return [*up, *((self.links[frame], False) for frame in reversed(below[: below.index(common)]))]

    def _upwards(self, frame: str) -> list[str]:
        """A frame, its parent, that one's, to the root.

        Raises:
            InputError: for a frame with several parents, or none that ends.
        """
        frames = [frame]
        while frames[-1] in self.links and len(self.links[frames[-1]]):
            child = frames[-1]
            if len(self.parents[child]) > 1:
                some = " and ".join(map(repr, sorted(self.parents[child])[:2]))
                raise InputError(f"{self.bag.path}: frame {child!r} has the parents {some}. Record with one parent.")
            frames.append(self.links[child].parent)
            if frames[-1] in frames[:-1]:
                raise InputError(f"{self.bag.path}: frame {child!r} is above itself in /tf. Record with a tree.")
        return frames


def along(path: Chain, ns: int) -> Matrix | Gap:
    """``first_from_last`` (4, 4) of a path's frames at a time, or the first gap."""
    matrix = np.eye(4)
    for link, is_upwards in path:
        found = link.at(ns)
        if isinstance(found, Gap):
            return found
        matrix = matrix @ (np.linalg.inv(found) if is_upwards else found)
    return matrix


def _matrix(position: Matrix, quaternion: Matrix) -> Matrix:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = matrix_from_quaternion(quaternion), position
    return matrix
