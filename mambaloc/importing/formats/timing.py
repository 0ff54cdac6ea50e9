"""Which pose is which image's, where both are named by numbers: by equal names, or by the nearest time stamps.

Time stamps are compared as whole nanoseconds: float64 is off by 128 ns at today's times. Their unit is found by
their size. Times since 1970 are of one size in each unit, so that a file may mix units; the unit of others follows from
the median step.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.images import IMAGE_SUFFIXES

FARTHEST_S = 0.02
"""Time stamps that differ by more are not associated: the default of TUM's ``associate.py``."""

UNITS_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_PER_S = {unit: 10**9 // per_ns for unit, per_ns in UNITS_NS.items()}
_SINCE_1970_S = (5 * 10**8, 5 * 10**9)  # from 1985 to 2128
_LONGEST_STEP_S = 2  # from a frame to the next
_MIN_INTEGER_STEP = 2000  # frames are numbered in smaller steps
_LARGEST_NS = 2**62
_MAX_FRAMES = 10**6  # a larger number is not a frame's
_NUMBER = re.compile(r"\D*?(\d+(?:\.\d+)?)\D*", re.ASCII)


@dataclass(frozen=True)
class Stamps:
    """Times.

    Args:
        ns: (N,) int64, nanoseconds.
        unit: in which they were written; several where each has its own.
    """

    ns: NDArray[np.int64]
    unit: str

    @property
    def seconds(self) -> NDArray[np.float64]:
        """(N,), as exactly as float64 has them."""
        return self.ns / 1e9

    @property
    def span(self) -> str:
        """From when to when, for messages."""
        return f"{self.ns.min() / 1e9:.2f} to {self.ns.max() / 1e9:.2f} s, read as {self.unit}"


def stamps_of(words: Sequence[str], like: Stamps | None = None, stated_unit: str = "") -> Stamps | None:
    """Times of words, in the unit that fits their size; None where one is not a number.

    Args:
        words: as they were written.
        like: other times of the same recording: of units that could be, the one in which both overlap most.
        stated_unit: the unit that a file states; taken where their size allows it.
    """
    numbers = [number for word in words if (number := _number(word)) is not None]
    if not numbers or len(numbers) < len(words):
        return None
    own = [unit for number in numbers if (unit := _since_1970(number)) is not None]
    if len(set(own)) > 1 and len(own) == len(numbers):
        parts = [int((number * UNITS_NS[unit]).to_integral_value()) for number, unit in zip(numbers, own, strict=True)]
        return Stamps(np.array(parts, dtype=np.int64), " and ".join(dict.fromkeys(own)))
    units = {unit: _in_ns(numbers, unit) for unit in _possible(numbers)}
    known = {unit: ns for unit, ns in units.items() if ns is not None}
    if not known:
        return None
    if stated_unit in known:
        unit = stated_unit
    else:
        unit = next(iter(known)) if like is None else max(known, key=lambda each: _overlap(known[each], like.ns))
    return Stamps(known[unit], unit)


def _number(word: str) -> Decimal | None:
    """A finite number that may be a time; None for anything else, also for ``1_5``, which Python takes for 15."""
    try:
        number = Decimal(word) if "_" not in word else Decimal("nan")
    except InvalidOperation:
        return None
    return number if number.is_finite() and number.copy_abs() < _LARGEST_NS else None  # abs() may overflow


def _possible(numbers: Sequence[Decimal]) -> list[str]:
    """Units that numbers may be in, the likeliest first."""
    ordered = sorted(numbers)
    middle = ordered[len(ordered) // 2]
    if (unit := _since_1970(middle)) is not None:
        return [unit]
    steps = sorted(after - before for before, after in pairwise(ordered) if after > before)
    step = steps[len(steps) // 2] if steps else Decimal(1)
    likeliest = next((unit for unit in UNITS_NS if step <= _LONGEST_STEP_S * _PER_S[unit]), "ns")
    return [likeliest, *(unit for unit in UNITS_NS if unit != likeliest)]


def _since_1970(number: Decimal) -> str | None:
    """The unit in which a number is a time since 1970; None if it is a time in no unit."""
    first, last = _SINCE_1970_S
    return next((unit for unit, scale in _PER_S.items() if first * scale <= number < last * scale), None)


def _in_ns(numbers: Sequence[Decimal], unit: str) -> NDArray[np.int64] | None:
    per = UNITS_NS[unit]
    ns = [int((number * per).to_integral_value()) for number in numbers]
    return np.array(ns, dtype=np.int64) if max(map(abs, ns)) < _LARGEST_NS else None


def _overlap(some: NDArray[np.int64], others: NDArray[np.int64]) -> float:
    """The length that two spans share, over that of both together."""
    shared = min(int(some.max()), int(others.max())) - max(int(some.min()), int(others.min()))
    return shared / max(max(int(some.max()), int(others.max())) - min(int(some.min()), int(others.min())), 1)


def image_words(images: Sequence[Path]) -> list[str]:
    """The number that each image is named by, as ``1.5`` of ``cam_1.5.png``; the stem where it has no single one."""
    found = [_NUMBER.fullmatch(image.stem) for image in images]
    return [image.stem if match is None else match[1] for image, match in zip(images, found, strict=True)]


def image_stamps(images: Sequence[Path]) -> Stamps | None:
    """Times that images are named by, if they are; small whole numbers could as well count frames."""
    words = image_words(images)
    stamps = stamps_of(words)
    if stamps is None or all("." in word for word in words):
        return stamps
    numbers = sorted(map(Decimal, words))
    steps = sorted(after - before for before, after in pairwise(numbers))
    is_epoch = len(_possible(numbers)) == 1
    return stamps if is_epoch or (steps and steps[len(steps) // 2] >= _MIN_INTEGER_STEP) else None


@dataclass(frozen=True)
class Pairing:
    """Which pose is which image's.

    Args:
        frames: each image that has a pose, the row of that, and the image's time; None where names are not times.
        how: it was found, for ``choices``.
        missing: names of poses whose image is not there.
    """

    frames: list[tuple[Path, int, float | None]]
    how: str
    missing: list[str]


def pair(images: Sequence[Path], words: Sequence[str], listing: Path) -> Pairing:
    """Pair images with poses whose lines begin with words, by name, or else by time.

    Args:
        images: some.
        words: a pose's name, number or time stamp each.
        listing: the file of the poses, for messages.

    Raises:
        InputError: where names do not match poses to images.
    """
    named, stamps = _by_name(images, words), image_stamps(images)
    if named is not None:
        pairs, how, missing = named
        return Pairing(_frames(images, stamps, pairs), how, missing)
    if stamps is None:
        raise InputError(
            f"{listing}: its poses cannot be matched to images: {images[0].name!r} is neither a time stamp such "
            f"as 1305031102.175304.png, nor in its first column. Write the images' names into its first column, or "
            f"lines 'timestamp file' to {listing.with_name('rgb.txt')} and call the trajectory groundtruth.txt."
        )
    pairs, how = by_time(images[0].parent, stamps, words, listing)
    return Pairing(_frames(images, stamps, pairs), f"{how}; images are named in {stamps.unit}", [])


def _frames(
    images: Sequence[Path], stamps: Stamps | None, pairs: Sequence[tuple[int, int]]
) -> list[tuple[Path, int, float | None]]:
    times_s = [None] * len(images) if stamps is None else stamps.seconds.tolist()
    return [(images[place], row, times_s[place]) for place, row in pairs]


def by_time(named: Path, stamps: Stamps, words: Sequence[str], listing: Path) -> tuple[list[tuple[int, int]], str]:
    """Pair images' times with those of poses, and say how.

    Args:
        named: what says the images' times, for messages.
        stamps: theirs.
        words: a pose's time each.
        listing: the file of the poses, for messages.

    Raises:
        InputError: where a word is not a time, or none is near.
    """
    poses = stamps_of(words, like=stamps)
    if poses is None:
        raise InputError(f"{listing}: its first column is not a time stamp in seconds throughout; correct it")
    pairs = associated(stamps.ns, poses.ns, round(FARTHEST_S * 1e9))
    if not pairs:
        raise InputError(
            f"{listing}: none of {len(words)} poses ({poses.span}) is within {FARTHEST_S} s of an image of {named} "
            f"({stamps.span}). Give images and poses of one recording, by one clock."
        )
    return pairs, f"nearest time stamps, within {FARTHEST_S} s; poses are timed in {poses.unit}"


def associated(first: NDArray[Any], second: NDArray[Any], farthest: float = FARTHEST_S) -> list[tuple[int, int]]:
    """Pair each of the first time stamps with the nearest of the second that is nearer than the farthest.

    Where one is nearest to several, only the closest keeps it: no pose is given to two images.

    Returns:
        Pairs of indices, in the order of the first.
    """
    order = np.argsort(second, kind="stable")
    ordered = second[order]
    after = np.searchsorted(ordered, first).clip(0, len(order) - 1)
    before = (after - 1).clip(0)
    nearest = np.where(first - ordered[before] <= np.abs(ordered[after] - first), before, after)
    difference = np.abs(ordered[nearest] - first)
    closest_first = np.argsort(difference, kind="stable")
    _, kept = np.unique(nearest[closest_first], return_index=True)
    rows = np.sort(closest_first[kept])
    return [(i, int(order[nearest[i]])) for i in rows[difference[rows] < farthest].tolist()]


def _by_name(images: Sequence[Path], words: Sequence[str]) -> tuple[list[tuple[int, int]], str, list[str]] | None:
    """Pair images with rows that name them; nothing where only some meet, by chance."""
    rows = {_plain(word): row for row, word in enumerate(words)}
    names = [_plain(image.name) for image in images]
    if all(word.isdecimal() for word in words):  # then frame_0012.jpg is 12's
        numbers = map(_plain, image_words(images))
        names = [name if name in rows else number for name, number in zip(names, numbers, strict=True)]
    found = [(i, rows[name]) for i, name in enumerate(names) if name in rows]
    if len(found) not in (len(images), len(words)) or len({row for _, row in found}) < len(found):
        return None
    unused = sorted(set(range(len(words))) - {row for _, row in found})
    return found, "the first column names the images", [words[row] for row in unused]


def _plain(name: str) -> str:
    """An image's name without folder and suffix, or the number that it is, however it is written."""
    file = name.rpartition("/")[2]
    before, dot, suffix = file.rpartition(".")
    stem = before if dot + suffix.lower() in IMAGE_SUFFIXES else file
    if not stem[:1].isdigit():
        return stem
    number = _number(stem)
    is_time = "." in stem.removesuffix(".0")  # 12.000 may be a second, and no frame's number
    if number is None or (is_time and number < _MAX_FRAMES):
        return stem
    return format(number.normalize(), "f")
