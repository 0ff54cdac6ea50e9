"""Hold out a validation set honestly, thin a training set, and cut it into clips.

Neighbouring frames are about 1 cm and 0.5 degrees apart, so a random split would leak.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.frames import Frames
from mambaloc.errors import InputError

Validation = Literal["auto", "marked", "sequences", "block", "none", "test_set"]
"""How the best epoch is chosen. ``marked`` takes the frames that an imported scene marks for it; ``auto`` does where
there are any, else holds out sequences where there are several, else a block; ``test_set`` selects on the test set, as
several published codes do, and is written into every result."""


def hold_out(
    frames: Frames,
    validation: Literal["auto", "sequences", "block"] = "auto",
    fraction: float = 0.1,
    gap: int = 20,
    sequences: list[str] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split training frames into those to train on and those to validate on.

    Args:
        frames: the training split.
        validation: by whole sequences, or by a block.
        fraction: share of frames to hold out: sequences from the last on until it is reached, or the end of each
            sequence.
        gap: frames dropped between a block and what is trained on.
        sequences: by name, the sequences to hold out instead of a fraction; or whose ends to hold out as blocks.

    Returns:
        Indices to train on and to validate on, (T,) and (V,).

    Raises:
        InputError: where one of the two would be empty, a sequence is not there, or a number is out of range.
    """
    by_sequence = frames.by_sequence()
    if not 0 < fraction < 1:
        raise InputError(f"data.val_fraction {fraction}: must lie between 0 and 1; or use data.validation: none")
    if gap < 0:
        raise InputError(f"data.val_gap {gap}: must be 0 or more, or the two would overlap")
    unknown = [name for name in sequences or [] if name not in by_sequence]
    if unknown:
        raise InputError(f"data.val_sequences: no {unknown[0]} in the training split; it has {', '.join(by_sequence)}")
    if validation == "sequences" or (validation == "auto" and (sequences or len(by_sequence) > 1)):
        held_out = sequences or _last_sequences(by_sequence, round(fraction * len(frames)))
        return _by_sequences(by_sequence, held_out)
    nothing = np.empty(0, dtype=np.int64)
    blocks = [
        _block(indices, fraction, gap) if not sequences or name in sequences else (indices, nothing)
        for name, indices in by_sequence.items()
    ]
    train, val = (np.concatenate(part) for part in zip(*blocks, strict=True))
    if not len(train) or not len(val):
        raise InputError(
            f"data.val_fraction {fraction} and val_gap {gap} leave {len(train)} frames to train and {len(val)} to "
            f"validate on, of {len(frames)}; change them, or use data.validation: none"
        )
    return train, val


def _last_sequences(by_sequence: dict[str, NDArray[np.int64]], wanted: int) -> list[str]:
    held_out: list[str] = []
    for name in reversed(list(by_sequence)):
        held_out.append(name)
        if sum(len(by_sequence[n]) for n in held_out) >= wanted:
            break
    return held_out


def _by_sequences(
    by_sequence: dict[str, NDArray[np.int64]], held_out: list[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    train = [indices for name, indices in by_sequence.items() if name not in held_out]
    if not train:
        raise InputError("data.validation: holding out these sequences leaves none to train on; use validation: block")
    return np.concatenate(train), np.concatenate([by_sequence[name] for name in by_sequence if name in held_out])


def _block(indices: NDArray[np.int64], fraction: float, gap: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cut the end of a sequence off, and a gap before it."""
    start = len(indices) - max(1, round(fraction * len(indices)))
    return indices[: max(0, start - gap)], indices[start:]


def subsample(frames: Frames, keep_every: int = 1, keep_count: int | None = None) -> NDArray[np.int64]:
    """Choose training frames uniformly in time.

    Args:
        frames: the training frames.
        keep_every: every k-th frame of each sequence: the paper's sparsity 1/k.
        keep_count: instead, so many frames in all, spread evenly over the sequences laid end to end.

    Returns:
        Indices, (K,).

    Raises:
        InputError: where a number is out of range.
    """
    if keep_count is not None:
        if keep_every != 1:
            raise InputError(f"data.keep_count {keep_count} and keep_every {keep_every}: give only one")
        if not 1 <= keep_count <= len(frames):
            raise InputError(f"data.keep_count {keep_count}: there are {len(frames)} training frames")
        return (np.arange(keep_count) * len(frames)) // keep_count
    if keep_every < 1:
        raise InputError(f"data.keep_every {keep_every}: must be 1 or more")
    return np.concatenate([indices[::keep_every] for indices in frames.by_sequence().values()])


def clips_of(frames: Frames, length: int, skip: int) -> NDArray[np.int64]:
    """Choose a clip around each frame, of its own sequence: MapNet's tuples, which never cross a border.

    The frame is the clip's middle where that fits, else an earlier or later one; where nothing fits, the frames lie
    closer together. Frames of a sequence that is shorter than a clip have none.

    Args:
        frames: the training frames.
        length: frames of a clip.
        skip: frames from one to the next.

    Returns:
        Indices in time order, (C, length).

    Raises:
        InputError: where a number is out of range or no sequence is long enough.
    """
    if length < 2 or skip < 1:
        raise InputError(
            f"data.clip_length {length} and clip_skip {skip}: a clip has 2 frames or more, 1 or more apart"
        )
    by_sequence = frames.by_sequence()
    clips = [
        indices[_clip_around(place, len(indices), length, skip)]
        for indices in by_sequence.values()
        if len(indices) >= length
        for place in range(len(indices))
    ]
    if not clips:
        longest = max(len(indices) for indices in by_sequence.values())
        raise InputError(
            f"data.clip_length {length}: the longest of {len(by_sequence)} training sequences has {longest} frames; "
            "clips need video, so choose a shorter clip, or a scene whose frames were taken in sequence"
        )
    return np.stack(clips)


def _clip_around(place: int, count: int, length: int, skip: int) -> NDArray[np.int64]:
    """Places of a clip that holds ``place`` within ``count`` frames."""
    slots = sorted(range(length), key=lambda slot: abs(slot - length // 2))
    starts = ((place - slot * step, step) for step in range(skip, 0, -1) for slot in slots)
    start, step = next((a, step) for a, step in starts if a >= 0 and a + (length - 1) * step < count)
    return start + step * np.arange(length)
