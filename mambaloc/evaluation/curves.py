"""Curves of trained systems side by side: errors frame by frame, while training, and over training sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.evaluation.evaluate import median_intervals
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.evaluation.trained import Trained
from mambaloc.metrics import PoseErrorTable, summarize
from mambaloc.viz.curves import Point, axis_limit, plot_cumulative, plot_errors_by_frames, plot_errors_by_time
from mambaloc.viz.png import write_png

_ERRORS = {"position_error_m": "position error (m)", "rotation_error_deg": "rotation error (°)"}


def draw_cumulative(trained: Sequence[Trained], path: Path, title: str) -> None:
    """Draw the share of test frames whose error is at most so large; a line a system, all its checkpoints together."""
    tables = {
        name: [localize_test_frames(each.system, each.data) for each in of] for name, of in _by_name(trained).items()
    }

    def draw(axes: Axes, error: str) -> None:
        errors = {name: _joined(of, error) for name, of in tables.items()}
        plot_cumulative(axes, errors)
        axes.set(xlabel=_ERRORS[error], ylabel="share of test frames")
        axes.set(xlim=(0, axis_limit(errors.values())), ylim=(0, 1))

    _write(draw, path, title)


def draw_time(trained: Sequence[Trained], path: Path, title: str) -> None:
    """Draw the validation errors of each checkpoint's training against its seconds.

    Raises:
        InputError: where a training kept no curve, as without validation.
    """
    for each in trained:
        if not _history(each):
            raise InputError(f"{each.checkpoint.path}: its training was not validated; train with data.validation")

    def draw(axes: Axes, error: str) -> None:
        curves: dict[str, list[tuple[list[float], list[float]]]] = {}
        for each in trained:
            history = _history(each)
            line = ([reading["train_s"] for reading in history], [reading[error] for reading in history])
            curves.setdefault(each.name, []).append(line)
        plot_errors_by_time(axes, curves)
        on_test = any(each.data.hparams["validation"] == "test_set" for each in trained)
        axes.set(
            xlabel="training time (s)", ylabel=f"median {_ERRORS[error]}, {'TEST' if on_test else 'held-out'} frames"
        )
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)

    _write(draw, path, title)


def draw_sparsity(trained: Sequence[Trained], path: Path, title: str) -> None:
    """Draw test medians, with their intervals over blocks of frames, against the number of training frames.

    Checkpoints of one system and one number of frames stand for their first: no mean over seeds is taken.

    Raises:
        InputError: where a checkpoint does not say how many frames it was trained on.
    """
    points: dict[str, dict[int, dict[str, Point]]] = {}
    for each in trained:
        frames, known = _training_frames(each), points.setdefault(each.name, {})
        if frames not in known:
            known[frames] = _points(each, frames)

    def draw(axes: Axes, error: str) -> None:
        plot_errors_by_frames(axes, {name: [point[error] for point in of.values()] for name, of in points.items()})
        axes.set(xlabel="training frames", ylabel=f"median {_ERRORS[error]}")
        axes.set_ylim(bottom=0)

    _write(draw, path, title)


def _history(trained: Trained) -> list[dict[str, float]]:
    """Medians of each validation of a training; none where it kept no curve."""
    return (trained.checkpoint.wall_clock or {}).get("history", [])


def _training_frames(trained: Trained) -> int:
    data = trained.checkpoint.provenance.get("data")
    if data is None:
        raise InputError(f"{trained.checkpoint.path}: has no number of training frames; train it again")
    return data["train_frames"]


def _points(trained: Trained, frames: int) -> dict[str, Point]:
    """Both medians with their intervals."""
    table = localize_test_frames(trained.system, trained.data)
    medians, intervals = summarize(table), median_intervals(table, trained.data.frames("test").sequences)
    return {error: Point(frames, medians[error], *intervals[error]) for error in _ERRORS}


def _by_name(trained: Sequence[Trained]) -> dict[str, list[Trained]]:
    found: dict[str, list[Trained]] = {}
    for each in trained:
        found.setdefault(each.name, []).append(each)
    return found


def _joined(tables: Sequence[PoseErrorTable], error: str) -> NDArray[np.float64]:
    return np.concatenate([getattr(table, error).cpu().double().numpy() for table in tables])


def _write(draw: Callable[[Axes, str], None], path: Path, title: str) -> None:
    """Both errors side by side, under one legend."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    for axes, error in zip(figure.subplots(1, 2), _ERRORS, strict=True):
        draw(axes, error)
    figure.suptitle(title, fontsize=11)
    handles, names = axes.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)
    write_png(figure, path)
