"""A capture from above and from the side: where its cameras are, where they look, and which split each is in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mambaloc.viz.png import write_png

COLORS = {"test": "#d73027", "val": "#f39c12", "train": "#2166ac", "unused": "#b0b0b0"}
_JUMP_COLOR = "#8e44ad"
_MAX_ARROWS = 160
_ARROW = 0.06  # of the plot's side
_MARGIN = 0.09  # so that arrows end inside
_WIDTH_IN, _NARROWEST_IN = 7.0, 4.0
_TALLEST = 1.5  # both panels' heights over their width

Floats = NDArray[np.float64]


def draw_capture(
    position: Floats,
    forward: Floats,
    up: Floats,
    split: Sequence[str],
    sequences: Sequence[str],
    jumps: Sequence[int],
    path: Path,
    title: str,
    unit: str,
) -> None:
    """Draw a capture's camera centres from above and from the side.

    Args:
        position: (N, 3).
        forward: unit, where each camera looks, (N, 3).
        up: unit, (3,): an axis of the world where one points up, whose other axes are then kept.
        split: of each frame.
        sequences: of each frame; lines do not cross from one to the next.
        jumps: rows that the camera jumps to.
        path: the PNG to write.
        title: heads the plot.
        unit: of positions.
    """
    axes, names = plot_axes(position, up)
    low, high = (np.array([extreme(position @ axis) for axis in axes]) for extreme in (np.min, np.max))
    side = float((high - low).max()) or 1.0
    low, high = low - _MARGIN * side, high + _MARGIN * side
    spans = high - low
    width_in = _WIDTH_IN * min(1.0, _TALLEST * spans[0] / (spans[1] + spans[2]))
    figure = Figure(
        figsize=(max(width_in, _NARROWEST_IN) + 0.8, width_in * (spans[1] + spans[2]) / spans[0] + 1.6),
        layout="constrained",
    )
    panels = figure.subplots(2, 1, height_ratios=spans[1:].tolist())
    for panel, vertical, view in zip(panels, (1, 2), ("from above", "from the side"), strict=True):
        plane = np.stack((axes[0], axes[vertical]), axis=1)
        _draw(panel, position @ plane, _ARROW * side * forward @ plane, np.array(split), np.array(sequences), jumps)
        panel.set(xlim=(low[0], high[0]), ylim=(low[vertical], high[vertical]), aspect="equal")
        panel.set_title(view, fontsize=9, loc="left", color="#555555")
        panel.set_ylabel(f"{names[vertical]} [{unit}]")
    panels[0].tick_params(labelbottom=False)
    panels[1].set_xlabel(f"{names[0]} [{unit}]")
    figure.suptitle(title, fontsize=11)
    figure.legend(handles=_legend(split, jumps), loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    write_png(figure, path)


def plot_axes(position: Floats, up: Floats) -> tuple[list[Floats], list[str]]:
    """Directions to plot along, right-handed: two that are level, and up; and what they are called."""
    vertical = int(np.abs(up).argmax())
    if np.abs(up[vertical]) > 1 - 1e-9:
        first, second = np.eye(3)[(vertical + 1) % 3], np.eye(3)[(vertical + 2) % 3] * np.sign(up[vertical])
        if np.ptp(position @ second) > np.ptp(position @ first):
            first, second = second, -first
        return [first, second, up], [_axis_name(each) for each in (first, second, up)]
    level = position - position.mean(axis=0)
    level = level - np.outer(level @ up, up)
    along = np.linalg.svd(level, full_matrices=False)[2][0]
    along = along - (along @ up) * up
    along = along / np.linalg.norm(along)
    return [along, np.cross(up, along), up], ["along", "across", "up"]


def _axis_name(axis: Floats) -> str:
    place = int(np.abs(axis).argmax())
    return f"{'-' if axis[place] < 0 else ''}{'xyz'[place]}"


def _draw(
    panel: Axes,
    position: Floats,
    arrows: Floats,
    split: NDArray[np.str_],
    sequences: NDArray[np.str_],
    jumps: Sequence[int],
) -> None:
    """Draw one view; everything is (N, 2) already."""
    for name in dict.fromkeys(sequences.tolist()):
        rows = np.flatnonzero(sequences == name)
        for piece in np.split(rows, np.flatnonzero(np.isin(rows, jumps))):
            panel.plot(*position[piece].T, color="#cccccc", linewidth=0.8, zorder=1)
    for row in jumps:
        panel.plot(*position[[row - 1, row]].T, color=_JUMP_COLOR, linewidth=1.0, linestyle="--", zorder=2)
    shown = np.linspace(0, len(position) - 1, min(_MAX_ARROWS, len(position))).round().astype(int)
    panel.quiver(
        *(*position[shown].T, *arrows[shown].T),
        color=[COLORS[each] for each in split[shown]],
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.0025,
        headwidth=3.5,
        headlength=4,
        headaxislength=3.5,
        zorder=3,
    )
    for name in reversed(COLORS):  # what is tested on last, on top
        x, y = position[split == name].T
        panel.scatter(x, y, color=COLORS[name], s=9, linewidths=0, zorder=4)
    panel.grid(color="#ececec", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.xaxis.set_major_locator(MaxNLocator(7))
    panel.yaxis.set_major_locator(MaxNLocator(5))


def _legend(split: Sequence[str], jumps: Sequence[int]) -> list[Line2D]:
    there = set(split)
    handles = [
        Line2D([], [], color=color, marker="o", markersize=5, linestyle="", label=name)
        for name, color in COLORS.items()
        if name in there
    ]
    if len(jumps):
        handles.append(Line2D([], [], color=_JUMP_COLOR, linestyle="--", linewidth=1.2, label="jump"))
    return handles
