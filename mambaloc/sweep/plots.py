"""What a sweep's results look like: a panel a system, a colour a label of what is compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mambaloc.sweep.summary import ERRORS, Row, history
from mambaloc.viz.curves import COLORS, Point, axis_limit, plot_cumulative, plot_errors_by_frames, plot_errors_by_time

NAMES = {"position_error_m": "median position (m)", "rotation_error_deg": "median rotation (°)"}

_COLUMNS = 3
_ERROR = "position error (m)"
_POSITION = "position_error_m"


@dataclass(frozen=True)
class Plot:
    """A figure and the sentence under it."""

    title: str
    text: str
    figure: Figure


def plots_of(rows: Sequence[Row], series: str | None) -> list[Plot]:
    """Draw what there is: errors of every row, against training frames, against training time, frame by frame.

    Args:
        rows: of a store.
        series: the axis whose labels have a colour each, if any.
    """
    plots = [Plot("Errors", "Means over seeds of median errors, with their intervals.", _dots(rows, series))]
    first = next(iter(rows[0].labels))
    by_system: dict[str, list[Row]] = {}
    for row in rows:
        by_system.setdefault(row.labels[first], []).append(row)
    full = {name: _on_most_frames(group) for name, group in by_system.items()}
    if any(len(full[name]) < len(group) for name, group in by_system.items()):
        text = "Median position errors against the number of training frames; dashed: retrieval among the same frames."
        figure = _panels(by_system, lambda axes, group: _by_frames(axes, group, series), "training frames", _ERROR)
        plots.append(Plot("Errors and training frames", text, figure))
    if all(history(trial) for row in rows for trial in row.trials):
        text = "Median position errors while training on the most frames, a line a seed; dashed: retrieval."
        figure = _panels(
            full, lambda axes, group: _by_time(axes, group, series), "training time (s)", _ERROR, sharex=False
        )
        plots.append(Plot("Errors and training time", text, figure))
    text = "Share of test frames whose position error is at most so large; trained on the most frames, all seeds."
    figure = _panels(full, lambda axes, group: _cumulative(axes, group, series), _ERROR, "share of frames")
    errors_m = (
        np.array(trial["frames"][_POSITION]) for group in full.values() for row in group for trial in row.trials
    )
    figure.axes[0].set(xlim=(0, axis_limit(errors_m)), ylim=(0, 1))
    return [*plots, Plot("Errors frame by frame", text, figure)]


def _on_most_frames(group: list[Row]) -> list[Row]:
    max_frames = max(row.train_frames for row in group)
    return [row for row in group if row.train_frames == max_frames]


def _dots(rows: Sequence[Row], series: str | None) -> Figure:
    figure = Figure(figsize=(10, 1.2 + 0.22 * len(rows)), layout="constrained")
    places = np.arange(len(rows))[::-1]
    colors = _colors(rows, series)
    for axes, name in zip(figure.subplots(1, len(ERRORS), sharey=True), ERRORS, strict=True):
        for row, place in zip(rows, places, strict=True):
            error = row.errors[name]
            ends = [[max(0.0, error.mean - error.low)], [max(0.0, error.high - error.mean)]]
            axes.errorbar([error.mean], [place], xerr=ends, fmt="o", ms=4, lw=1, color=colors[_label(row, series)])
        axes.set_xlabel(NAMES[name])
        axes.set_xlim(left=0)
        axes.grid(axis="x", color="#e5e7eb")
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.set_yticks(places, [" ".join(row.labels.values()) for row in rows], fontsize=8)
        axes.set_ylim(-0.8, len(rows) - 0.2)
        axes.tick_params(axis="y", length=0)
    return figure


def _panels(
    groups: dict[str, list[Row]], draw: Callable[[Axes, list[Row]], None], x: str, y: str, sharex: bool = True
) -> Figure:
    lines = -(-len(groups) // _COLUMNS)
    columns = min(_COLUMNS, len(groups))
    figure = Figure(figsize=(0.4 + 3.2 * columns, 0.6 + 2.1 * lines), layout="constrained")
    every = np.ravel(figure.subplots(lines, columns, sharex=sharex, sharey=True, squeeze=False))
    for axes, (name, group) in zip(every, groups.items(), strict=False):
        draw(axes, group)
        axes.set_title(name, fontsize=10, loc="left")
    for axes in every[len(groups) :]:
        axes.set_visible(False)
    figure.supxlabel(x, fontsize=10)
    figure.supylabel(y, fontsize=10)
    every[0].set_ylim(bottom=0)  # shared, so only once all are drawn
    handles, names = every[0].get_legend_handles_labels()
    if len(handles) > 1:
        figure.legend(handles, names, loc="outside upper right", ncols=len(handles), frameon=False, fontsize=9)
    return figure


def _by_frames(axes: Axes, group: list[Row], series: str | None) -> None:
    points: dict[str, list[Point]] = {}
    for row in group:
        error = row.errors[_POSITION]
        points.setdefault(_label(row, series), []).append(Point(row.train_frames, error.mean, error.low, error.high))
    plot_errors_by_frames(axes, points)
    if retrieved := sorted({(row.train_frames, error_m) for row in group for error_m in _retrieval(row)}):
        axes.plot(*zip(*retrieved, strict=True), color="#111827", lw=0.9, ls="--", zorder=1)


def _by_time(axes: Axes, group: list[Row], series: str | None) -> None:
    trainings: dict[str, list[tuple[list[float], list[float]]]] = {}
    for row in group:
        for trial in row.trials:
            curve = history(trial)
            line = ([each["train_s"] for each in curve], [each[_POSITION] for each in curve])
            trainings.setdefault(_label(row, series), []).append(line)
    plot_errors_by_time(axes, trainings)
    for error_m in {error_m for row in group for error_m in _retrieval(row)}:
        axes.axhline(error_m, color="#111827", lw=0.9, ls="--", zorder=1)


def _cumulative(axes: Axes, group: list[Row], series: str | None) -> None:
    errors: dict[str, list[float]] = {}
    for row in group:
        for trial in row.trials:
            errors.setdefault(_label(row, series), []).extend(trial["frames"][_POSITION])
    plot_cumulative(axes, {name: np.array(each) for name, each in errors.items()})


def _retrieval(row: Row) -> list[float]:
    return [row.references["retrieval"][_POSITION]] if "retrieval" in row.references else []


def _label(row: Row, series: str | None) -> str:
    return row.labels.get(series, "") if series else ""


def _colors(rows: Sequence[Row], series: str | None) -> dict[str, str]:
    labels = list(dict.fromkeys(_label(row, series) for row in rows))
    return {label: COLORS[number % len(COLORS)] for number, label in enumerate(labels)}
