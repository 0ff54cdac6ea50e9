"""Proposes splits of a capture: as its files have it, by recordings, by passes, by blocks with gaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mambaloc.importing.capture import Capture
from mambaloc.importing.motion import Motion, pairwise_distances, quaternions
from mambaloc.importing.splits.selection import (
    COVERAGE_DEG,
    MAX_NEAR,
    NEAR_STEPS,
    Kind,
    SplitCandidate,
    best_of,
    distances,
    measured,
)

TEST_SHARE, VAL_SHARE = 0.2, 0.1

_MIN_BLOCK = 3
_MAX_BLOCKS = 5
_GAP_SHARE, _MIN_GAP = 0.02, 1
_AT_ONCE = 500  # frames whose distances to all others are held
_MANY_SEQUENCES = 5  # of which every fifth makes a test split, too
_PASS_SHARE = 0.1  # of a sequence: frames nearer in time are of the same pass
_LOOP_REACH = 0.1  # of the extent
_COVERED = 0.9
_LOOP_SHARES = (TEST_SHARE, 0.15, 0.1)
_LOOP_FRAMES = 1500  # of a sequence that are looked at, evenly spread
_VAL_PLACES = 12
_MIN_STEPS = 1e-3  # where frames coincide

Rows = NDArray[np.int64]


def propose(capture: Capture, motion: Motion) -> list[SplitCandidate]:
    """One split of each kind that there can be, in the order of :data:`~mambaloc.importing.splits.selection.KINDS`.

    Each holds out a block of training frames for validation, too, unless the capture's own files have one.

    Args:
        capture: of twenty frames or more, all usable.
        motion: its.
    """
    advisor = _Advisor(capture, motion)
    found = (advisor.given(), advisor.by_sequence(), advisor.by_loop(), advisor.by_blocks())
    return [each for each in found if each is not None]


class _Advisor:
    def __init__(self, capture: Capture, motion: Motion) -> None:
        self.capture, self.motion = capture, motion
        self.position, self.quaternion = capture.world_from_cam[:, :3, 3], quaternions(capture)
        # Frames in no order of time are laid along the scene's longest axis, as if they were one recording.
        names = np.array(capture.sequences) if motion.in_order else np.full(len(capture.images), "all")
        self.sequences = [self._laid_out(np.flatnonzero(names == name)) for name in dict.fromkeys(names.tolist())]
        self.gap = max(_MIN_GAP, round(_GAP_SHARE * max(map(len, self.sequences))))

    def given(self) -> SplitCandidate | None:
        split = np.array(self.capture.split if self.capture.split is not None else (), dtype="<U6")
        if not _is_complete(split):
            return None
        return self.with_validation(self._measured("given", "as the capture's own files have it", split))

    def by_sequence(self) -> SplitCandidate | None:
        """Whole recordings: of what makes a good split, the one nearest to a fifth of all frames."""
        groups = [[sequence] for sequence in self.sequences]
        if len(self.sequences) >= _MANY_SEQUENCES:
            groups += [self.sequences[first::_MANY_SEQUENCES] for first in range(_MANY_SEQUENCES)]
        total = len(self.capture.images)
        found: list[SplitCandidate] = []
        for group in groups if len(self.sequences) > 1 else []:
            rows = np.concatenate(group)
            if _MIN_BLOCK <= len(rows) <= total / 2:
                named = ", ".join(self.capture.sequences[rows[0]] for rows in group)
                how = f"{named if len(named) < 60 else f'every {_MANY_SEQUENCES}th'} of {len(self.sequences)} sequences"
                found.append(self._measured("sequence", how, self._split(test=rows)))
        if not found:
            return None
        return self.with_validation(
            min(found, key=lambda each: (not each.is_good, abs(each.counts["test"] / total - TEST_SHARE)))
        )

    def by_loop(self) -> SplitCandidate | None:
        """A stretch of the longest sequence that the camera passed at another time, too."""
        rows = max(self.sequences, key=len)
        block = self._seen_again(rows) if self.motion.in_order else None
        if block is None:
            return None
        how = f"{len(block)} successive frames that another pass sees, too; gaps of {self.gap}"
        return self.with_validation(self._measured("loop", how, self._in_blocks([block], self.gap)))

    def _seen_again(self, rows: Rows) -> Rows | None:
        """The block of a sequence that is best seen from another pass, a fifth of it or less; None where none is."""
        every = -(-len(rows) // _LOOP_FRAMES)
        thin = rows[::every]
        length, turn_deg = pairwise_distances(self.position, self.quaternion, thin, thin)
        is_seen = (length <= _LOOP_REACH * self.motion.extent) & (turn_deg <= COVERAGE_DEG)
        steps = self.motion.steps(length, turn_deg)
        time = np.arange(len(thin))
        window = max(self.gap, round(_PASS_SHARE * len(thin)))
        for share in _LOOP_SHARES:
            size = max(_MIN_BLOCK, round(share * len(thin)))
            found = []
            for start in range(0, len(thin) - size + 1, max(1, size // 8)):
                block, others = slice(start, start + size), (time < start - window) | (time >= start + size + window)
                if others.any() and is_seen[block][:, others].any(axis=1).mean() >= _COVERED:
                    nearest = steps[block][:, others].min(axis=1)
                    leaks = bool((nearest <= NEAR_STEPS).mean() > MAX_NEAR)
                    found.append((leaks, float(np.quantile(nearest, 0.9)), start))
            if found:
                start = min(found)[2]
                return rows[start * every : (start + size) * every]
        return None

    def by_blocks(self) -> SplitCandidate | None:
        """Evenly spread blocks of a fifth of all frames, as few as make a good split; what is near them is left out."""
        total = len(self.capture.images)
        found: list[SplitCandidate] = []
        for count in range(1, _MAX_BLOCKS + 1):
            size = max(1, round(TEST_SHARE * total / count))
            if found and size < _MIN_BLOCK:
                break
            split = self._without_near(self._in_blocks(self._spread(count, size), self.gap))
            blocks = f"{count} block{'s' if count > 1 else ''} of {size} frames"
            how = f"{blocks}, gaps of {self.gap} frames and {NEAR_STEPS:g} steps"
            found.append(self.with_validation(self._measured("block", how, split)))
            if found[-1].is_good:
                return found[-1]
        return best_of(found)

    def _without_near(self, split: NDArray[np.str_]) -> NDArray[np.str_]:
        """The split without the training frames that are near a test frame of their sequence, if others are left."""
        sparse = split.copy()
        for rows in self.sequences:
            test, near = rows[split[rows] == "test"], np.zeros(len(rows), dtype=bool)
            for start in range(0, len(test), _AT_ONCE):
                length, turn_deg = pairwise_distances(
                    self.position, self.quaternion, test[start : start + _AT_ONCE], rows
                )
                steps = self.motion.steps(length, turn_deg)
                near |= (steps <= NEAR_STEPS).any(axis=0)
            sparse[rows[near & (split[rows] == "train")]] = "unused"
        return sparse if _is_complete(sparse) else split

    def with_validation(self, proposal: SplitCandidate) -> SplitCandidate:
        """Mark training frames for validation: a block, after a gap, or a recording.

        What is taken is as far from the rest as test frames are, and leaves those no farther than they were, both as
        nearly as can be.
        """
        if (proposal.split == "val").any():
            return proposal
        train = proposal.split == "train"
        size = max(_MIN_BLOCK, round(VAL_SHARE * len(self.capture.images)))
        best, lowest_cost = proposal, np.inf
        for rows in self._places(train, size):
            split = proposal.split.copy()
            split[self._around(rows, self.gap) & train] = "unused"
            split[rows] = "val"
            if (split == "train").sum() < size:
                continue
            found = self._measured(proposal.kind, proposal.how, split)
            of_val = distances(self.capture, self.motion, rows, np.flatnonzero(split == "train"))[2]
            cost = abs(_log_ratio(np.median(of_val), found.steps[1])) + _log_ratio(found.steps[1], proposal.steps[1])
            if cost < lowest_cost:
                best, lowest_cost = found, cost
        return best

    def _places(self, train: NDArray[np.bool_], size: int) -> list[Rows]:
        """Where validation frames may come from: blocks of training frames, and sequences of about that size."""
        runs: list[Rows] = []
        whole: list[Rows] = []
        for rows in self.sequences:
            is_train = train[rows]
            borders = np.flatnonzero(np.diff(is_train)) + 1
            runs += [run for run in np.split(rows, borders) if train[run[0]]]
            if is_train.all() and size / 2 <= len(rows) <= 2 * size and len(self.sequences) > 1:
                whole.append(rows)
        size = min(size, max(map(len, runs)))
        starts = [(run, start) for run in runs for start in range(0, len(run) - size + 1)]
        chosen = np.linspace(0, len(starts) - 1, min(_VAL_PLACES, len(starts))).round().astype(int)
        return [starts[place][0][starts[place][1] :][:size] for place in chosen] + whole

    def _laid_out(self, rows: Rows) -> Rows:
        if self.motion.in_order:
            return rows
        position = self.position[rows]
        longest = np.linalg.svd(position - position.mean(axis=0), full_matrices=False)[2][0]
        return rows[np.argsort(position @ longest, kind="stable")]

    def _spread(self, count: int, size: int) -> list[Rows]:
        """Blocks around evenly spread places of the sequences laid end to end, each within its sequence."""
        ends = np.cumsum([len(rows) for rows in self.sequences])
        blocks = []
        for number in range(count):
            middle = round(ends[-1] * (2 * number + 1) / (2 * count))
            place = int(np.searchsorted(ends, middle, side="right"))
            rows = self.sequences[place]
            start = min(max(0, middle - int(ends[place] - len(rows)) - size // 2), max(0, len(rows) - size))
            blocks.append(rows[start : start + size])
        return blocks

    def _in_blocks(self, blocks: Sequence[Rows], gap: int) -> NDArray[np.str_]:
        split = self._split(test=np.concatenate(blocks))
        around = np.any([self._around(rows, gap) for rows in blocks], axis=0)
        split[around & (split == "train")] = "unused"
        return split

    def _around(self, rows: Rows, gap: int) -> NDArray[np.bool_]:
        """Frames of the same sequences that are so near in time, (N,)."""
        found = np.zeros(len(self.capture.images), dtype=bool)
        for sequence in self.sequences:
            places = np.flatnonzero(np.isin(sequence, rows))
            if len(places):
                found[sequence[max(0, places[0] - gap) : places[-1] + 1 + gap]] = True
        return found

    def _split(self, test: Rows) -> NDArray[np.str_]:
        split = np.full(len(self.capture.images), "train", dtype="<U6")
        split[test] = "test"
        return split

    def _measured(self, kind: Kind, how: str, split: NDArray[np.str_]) -> SplitCandidate:
        return measured(kind, how, split, self.capture, self.motion)


def _is_complete(split: NDArray[np.str_]) -> bool:
    return {"train", "test"} <= set(split.tolist())


def _log_ratio(a: float | np.floating, b: float) -> float:
    return float(np.log(max(a, _MIN_STEPS) / max(b, _MIN_STEPS)))
