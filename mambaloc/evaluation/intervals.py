"""Confidence intervals of a median: bootstrap over blocks of a video, since errors of neighbours are correlated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

BLOCK = 20  # frames
RESAMPLES = 2000
LEVEL = 0.95

Rows = NDArray[np.int64]


def block_resamples(sequences: Sequence[str], block: int = BLOCK, resamples: int = RESAMPLES, seed: int = 0) -> Rows:
    """Draw frames with replacement in blocks that never cross a sequence's border.

    The moving-block bootstrap (Künsch 1989): frames one by one would count each second of video as many independent
    trials, and give an interval far too narrow.

    Args:
        sequences: each frame's sequence, in the order of the frames.
        block: frames; a sequence of fewer is one block.
        resamples: how often.
        seed: of the draws.

    Shape:
        (resamples, N) rows of the frames.
    """
    names = np.asarray(sequences)
    spans = [np.flatnonzero(names == name) for name in dict.fromkeys(sequences)]
    blocks = [span[i : i + block] for span in spans for i in range(max(1, len(span) - block + 1))]
    enough = -(-len(names) // min(map(len, blocks)))
    draws = np.random.default_rng(seed).integers(len(blocks), size=(resamples, enough))
    return np.stack([np.concatenate([blocks[i] for i in draw])[: len(names)] for draw in draws])


def median_interval(errors: NDArray[np.floating], rows: Rows, level: float = LEVEL) -> tuple[float, float]:
    """The interval of the median: percentiles of the resampled ones.

    Args:
        errors: (N,), one a frame.
        rows: of :func:`block_resamples`.
        level: share of resamples inside.
    """
    return _middle(np.median(errors[rows], axis=1), level)


def difference_interval(
    a: NDArray[np.floating], b: NDArray[np.floating], rows: Rows, level: float = LEVEL
) -> tuple[float, float, float]:
    """Median of ``a`` less median of ``b`` on the same frames, and its interval: (difference, low, high).

    Args:
        a: errors of one system, (N,).
        b: errors of another on the same frames.
        rows: of :func:`block_resamples`; both are resampled alike.
        level: share of resamples inside.

    Raises:
        ValueError: where they have not the same frames.
    """
    if a.shape != b.shape:
        raise ValueError(f"paired errors have the same frames, not {a.shape} and {b.shape}")
    differences = np.median(a[rows], axis=1) - np.median(b[rows], axis=1)
    return (float(np.median(a) - np.median(b)), *_middle(differences, level))


def _middle(values: NDArray[np.floating], level: float) -> tuple[float, float]:
    with np.errstate(invalid="ignore"):  # between two infinite medians, of frames without a pose
        low, high = np.nan_to_num(np.quantile(values, [(1 - level) / 2, (1 + level) / 2]), nan=np.inf, posinf=np.inf)
    return float(low), float(high)
