"""Ways to split a capture, each measured, and the rule that chooses one.

A test frame beside a training frame tests memory; one that is nowhere near any tests luck. So every proposal says how
far its test frames are from their nearest training frame, in steps of the capture: the larger of the distance in median
steps and the turn in median turns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.importing.capture import Capture
from mambaloc.importing.motion import Motion, pairwise_distances, quaternions

Kind = Literal["given", "sequence", "loop", "block"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""In the order in which the rule prefers them: what the capture says, then recordings, most like what comes later."""
ASKED = ("auto", *KINDS)

NEAR_STEPS = 2.0
MAX_NEAR = 0.1
COVERAGE_RADIUS = 0.25
COVERAGE_DEG = 30.0
RULE = (
    f"A split is honest where at most {MAX_NEAR:.0%} of its test frames are near, within {NEAR_STEPS:g} steps of a "
    f"training frame, and learnable where the median test frame's nearest one is within {COVERAGE_RADIUS:.0%} of the "
    f"scene's extent and {COVERAGE_DEG:g}°. A given split is taken, whatever it measures. Of the others, the first "
    f"that is both is taken, in the order {', '.join(KINDS[1:])}; failing that, the one with the fewest near frames of "
    "those that are learnable, or of all, and then the nearest."
)

_MEASURED = 400  # test frames at most, evenly spread

Quantiles = tuple[float, float, float]


@dataclass(frozen=True)
class SplitCandidate:
    """A way to split a capture.

    Args:
        kind: by what.
        how: in a line.
        split: ``train``, ``val``, ``test`` or ``unused``, of each frame.
        length: from each test frame to its nearest training frame: 10 % quantile, median and 90 % quantile.
        turn_deg: quantiles of the angle to its view direction.
        steps: quantiles of the distance in median frame spacings.
        near: share of test frames within :data:`NEAR_STEPS` steps.
        is_covered: the median is within reach.
    """

    kind: Kind
    how: str
    split: NDArray[np.str_]
    length: Quantiles
    turn_deg: Quantiles
    steps: Quantiles
    near: float
    is_covered: bool

    @property
    def is_leak_free(self) -> bool:
        """Whether hardly any test frame is a training frame's neighbour."""
        return self.near <= MAX_NEAR

    @property
    def is_good(self) -> bool:
        """Whether it is honest and learnable."""
        return self.is_leak_free and self.is_covered

    @property
    def counts(self) -> dict[str, int]:
        """Frames of each split."""
        return {split: int((self.split == split).sum()) for split in ("train", "val", "test", "unused")}

    def figures(self) -> Mapping[str, Any]:
        """Describe the split for ``scene.json``."""
        quantiles = {"length": self.length, "turn_deg": self.turn_deg, "steps": self.steps}
        return {
            "by": self.kind,
            "how": self.how,
            "frames": self.counts,
            "test_to_nearest_train": {
                name: dict(zip(("10%", "median", "90%"), (round(each, 5) for each in values), strict=True))
                for name, values in quantiles.items()
            },
            f"within_{NEAR_STEPS:g}_steps": round(self.near, 4),
            "honest": self.is_leak_free,
            "learnable": self.is_covered,
        }


@dataclass(frozen=True)
class SelectedSplit:
    """A proposal, why it was taken, and what is wrong with it still; empty where nothing is."""

    proposal: SplitCandidate
    why: str
    warning: str


def choose(proposals: Sequence[SplitCandidate], asked: str, capture: Capture) -> SelectedSplit:
    """Take a proposal: the one asked for, or by :data:`RULE`.

    Args:
        proposals: in the order of :data:`KINDS`.
        asked: of :data:`ASKED`.
        capture: that they split.

    Raises:
        InputError: if no split of the kind asked for exists.
    """
    if asked != "auto":
        taken = next((each for each in proposals if each.kind == asked), None)
        if taken is None:
            there = ", ".join(each.kind for each in proposals)
            lacks = _lacks_given(capture) if asked == "given" else _LACKS[asked]
            raise InputError(f"--split {asked}: this capture has {lacks}; choose one of auto, {there}")
        return SelectedSplit(taken, "it was asked for", _warning(taken, capture))
    given = next((each for each in proposals if each.kind == "given"), None)
    taken = given or next((each for each in proposals if each.is_good), None) or best_of(proposals)
    if given:
        why = "the capture gives it"
    elif taken.is_good:
        why = "the first that is honest and learnable"
    else:
        why = "none is both honest and learnable, it comes nearest"
    return SelectedSplit(taken, why, _warning(taken, capture))


_LACKS = {
    "sequence": "one sequence",
    "loop": "no path that comes back",
    "block": "too few frames",
}


def _lacks_given(capture: Capture) -> str:
    """Why a capture's own split cannot be used."""
    if capture.split is None:
        return capture.split_concern or "no split of its own"
    counts = " and ".join(f"{capture.split.count(split)} {split} frames" for split in ("train", "test"))
    return f"a split of its own with {counts} whose poses and images can be used, and both are needed"


def best_of(proposals: Sequence[SplitCandidate]) -> SplitCandidate:
    """The one with the fewest near frames of those that are learnable, or of all; among honest ones, the nearest."""
    return min(proposals, key=lambda each: (not each.is_covered, max(each.near, MAX_NEAR), each.steps[1]))


def measured(kind: Kind, how: str, split: NDArray[np.str_], capture: Capture, motion: Motion) -> SplitCandidate:
    """Measure how far test frames are from training frames."""
    test, train = np.flatnonzero(split == "test"), np.flatnonzero(split == "train")
    length, turn_deg, steps = distances(capture, motion, test, train)
    is_covered = bool(np.median(length) <= COVERAGE_RADIUS * motion.extent and np.median(turn_deg) <= COVERAGE_DEG)
    near = float((steps <= NEAR_STEPS).mean())
    return SplitCandidate(
        kind, how, split, _quantiles(length), _quantiles(turn_deg), _quantiles(steps), near, is_covered
    )


def distances(
    capture: Capture, motion: Motion, rows: NDArray[np.int64], others: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """From each of some frames to the nearest of others: lengths, degrees and steps, (R,) each.

    Of more than a few hundred, evenly spread ones are measured.
    """
    rows = rows[np.linspace(0, len(rows) - 1, min(_MEASURED, len(rows))).round().astype(int)]
    length, turn_deg = pairwise_distances(capture.world_from_cam[:, :3, 3], quaternions(capture), rows, others)
    steps = motion.steps(length, turn_deg)
    nearest = steps.argmin(axis=1)
    every = np.arange(len(rows))
    return length[every, nearest], turn_deg[every, nearest], steps[every, nearest]


def _quantiles(values: NDArray[np.float64]) -> Quantiles:
    low, middle, high = np.quantile(values, (0.1, 0.5, 0.9)).tolist()
    return low, middle, high


def _warning(taken: SplitCandidate, capture: Capture) -> str:
    listed = f"the capture has {capture.split_concern}" if capture.split_concern else ""
    if not taken.is_leak_free:
        warning = (
            f"the split by {taken.kind} leaks: {taken.near:.0%} of test frames are within {NEAR_STEPS:g} steps of a "
            "training frame, so test errors will look better than those between the frames"
        )
    elif not taken.is_covered:
        warning = (
            f"the split by {taken.kind} asks much: half of its test frames are {taken.steps[1]:.0f} steps or more "
            f"({taken.turn_deg[1]:.0f}°) from any training frame; record more passes"
        )
    else:
        warning = ""
    return "; ".join(filter(None, (listed, warning)))
