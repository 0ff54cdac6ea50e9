"""Error curves: over training time, over the number of training frames, and the share of frames below an error."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter, ScalarFormatter
from numpy.typing import NDArray

COLORS = ("#6b7280", "#1d4ed8", "#d97706", "#059669", "#be185d", "#7c3aed", "#0891b2", "#65a30d")
"""Of the first, second, ... system of a plot; the first, which others are compared with, is grey."""

_SHOWN = 95


@dataclass(frozen=True)
class Point:
    """A median error at a number of training frames, and the ends of its interval."""

    frames: int
    error: float
    low: float
    high: float


def plot_errors_by_time(axes: Axes, trainings: Mapping[str, Sequence[tuple[Sequence[float], Sequence[float]]]]) -> None:
    """Draw errors against training seconds, a line a training, a colour a system.

    Args:
        axes: to draw on.
        trainings: for each system the seconds and errors of each of its trainings.
    """
    for color, (name, lines) in zip(_colors(len(trainings)), trainings.items(), strict=True):
        for number, (seconds, errors) in enumerate(lines):
            axes.plot(seconds, errors, color=color, linewidth=1.4, marker=".", label=name if number == 0 else None)
    finish(axes)


def plot_errors_by_frames(axes: Axes, systems: Mapping[str, Sequence[Point]]) -> None:
    """Draw errors with their intervals against the number of training frames, on a logarithmic scale.

    Args:
        axes: to draw on.
        systems: for each system its points, in any order.
    """
    ticks = sorted({point.frames for points in systems.values() for point in points})
    for number, (color, (name, points)) in enumerate(zip(_colors(len(systems)), systems.items(), strict=True)):
        points = sorted(points, key=lambda point: point.frames)
        frames = [point.frames * 1.04 ** (number - (len(systems) - 1) / 2) for point in points]  # side by side
        ends = [[max(0.0, p.error - p.low) for p in points], [max(0.0, p.high - p.error) for p in points]]
        axes.errorbar(
            frames, [p.error for p in points], yerr=ends, color=color, linewidth=1.4, marker="o", ms=4, label=name
        )
    axes.set_xscale("log")
    axes.set_xticks(ticks)
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.minorticks_off()
    finish(axes)


def plot_cumulative(axes: Axes, errors: Mapping[str, NDArray[np.floating]]) -> None:
    """Draw the share of frames whose error is at most so large; the dotted line at a half meets each median.

    Args:
        axes: to draw on.
        errors: of each system's frames, (N,).
    """
    for color, (name, each) in zip(_colors(len(errors)), errors.items(), strict=True):
        share = np.arange(1, len(each) + 1) / len(each)
        axes.step(np.sort(each), share, where="post", color=color, linewidth=1.4, label=name)
    axes.axhline(0.5, color="#9ca3af", linewidth=0.8, linestyle=":")
    finish(axes)


def axis_limit(errors: Iterable[NDArray[np.floating]]) -> float:
    """Where a cumulative plot ends: one lost frame would flatten the rest, so at the worst system's 95th percentile."""
    return max(float(np.percentile(each, _SHOWN)) for each in errors)


def _colors(count: int) -> list[str]:
    return [COLORS[number % len(COLORS)] for number in range(count)]


def finish(axes: Axes) -> None:
    """Give axes the look of all curves: a faint grid below, no frame above and on the right."""
    axes.grid(color="#e5e7eb", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
