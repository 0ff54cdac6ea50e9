"""The paper's outdoor figure: true path and predicted positions from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mambaloc.metrics import PoseErrorTable
from mambaloc.viz.png import write_png
from mambaloc.viz.trajectory import PREDICTED_COLOR, means, medians

_WIDTH_IN, _MIN_HEIGHT_IN, _MAX_HEIGHT_IN = 7.5, 2.0, 9.0


def draw_top_view(table: PoseErrorTable, sequences: Sequence[str], path: Path, title: str) -> None:
    """Draw a split from above: its true path (black, a star where it starts) and predicted positions (red).

    Args:
        table: errors of the split, one row a frame.
        sequences: each frame's sequence; the path breaks from one to the next.
        path: the PNG to write.
        title: heads the plot, before medians and means.
    """
    across, along = horizontal_axes(table.true_position_m.cpu().numpy())
    true_m, predicted_m = (
        each.cpu().numpy()[:, [across, along]] for each in (table.true_position_m, table.predicted_position_m)
    )
    both_m = np.vstack((true_m, predicted_m))
    low_m, high_m = np.nanmin(both_m, axis=0), np.nanmax(both_m, axis=0)  # frames without a pose are NaN
    margin_m = 0.04 * float((high_m - low_m).max()) or 1.0
    spans_m = high_m - low_m + 2 * margin_m
    height_in = np.clip(_WIDTH_IN * spans_m[1] / spans_m[0], _MIN_HEIGHT_IN, _MAX_HEIGHT_IN)
    figure = Figure(figsize=(_WIDTH_IN, float(height_in) + 1.2), layout="constrained")
    axes = figure.add_subplot(
        aspect="equal",
        xlim=(low_m[0] - margin_m, high_m[0] + margin_m),
        ylim=(low_m[1] - margin_m, high_m[1] + margin_m),
        xlabel=f"{'xyz'[across]} [m]",
        ylabel=f"{'xyz'[along]} [m]",
    )
    names = np.array(sequences)[table.index.cpu().numpy()]
    for name in dict.fromkeys(names):
        axes.plot(*true_m[names == name].T, color="black", linewidth=1.5, zorder=2)
    offsets = LineCollection(list(np.stack((true_m, predicted_m), axis=1)), colors=PREDICTED_COLOR, linewidths=0.4)
    axes.add_collection(offsets, autolim=False)
    axes.scatter(
        predicted_m[:, 0], predicted_m[:, 1], color=PREDICTED_COLOR, s=8, linewidths=0, zorder=3, label="prediction"
    )
    axes.plot([], [], color="black", linewidth=1.5, label="ground truth")
    axes.plot(*true_m[0], "*", color="black", markersize=13, markeredgecolor="white", zorder=4, label="first frame")
    axes.grid(color="#e5e5e5", linewidth=0.6)
    axes.set_axisbelow(True)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(6))
    axes.set_title(f"{title}\n{medians(table)}; {means(table)}; {len(table.index)} frames", fontsize=10)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    write_png(figure, path)


def horizontal_axes(position_m: NDArray[np.floating]) -> tuple[int, int]:
    """Choose the two axes of a top view, in their order: a path outdoors spreads least along the one that points up.

    Args:
        position_m: true camera centres, (N, 3).
    """
    first, second = sorted(np.argsort(position_m.var(axis=0), kind="stable")[1:].tolist())
    return first, second
