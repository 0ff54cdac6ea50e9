"""The paper's figure: true and predicted trajectory in 3-D, rotation errors as a bar along the frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mambaloc.metrics import PoseErrorTable, summarize
from mambaloc.viz.png import write_png

TRUE_COLOR, PREDICTED_COLOR = "#1a9850", "#d73027"
_FAINT_COLOR = "#9e9e9e"


def draw_trajectory(
    table: PoseErrorTable, sequences: Sequence[str], path: Path, title: str, network: PoseErrorTable | None = None
) -> None:
    """Draw a split's true (green) and predicted (red) camera centres, and rotation errors below.

    Args:
        table: errors of the split, one row a frame.
        sequences: each frame's sequence; lines do not cross from one to the next.
        path: the PNG to write.
        title: heads the plot, before the medians.
        network: what the network by itself says of the same frames, drawn faintly behind the predictions.
    """
    figure = Figure(figsize=(7.0, 6.8), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(14, 1))
    axes = figure.add_subplot(grid[0], projection="3d")
    true_m = table.true_position_m.cpu().numpy()
    names = np.array(sequences)[table.index.cpu().numpy()]
    for name in dict.fromkeys(names):
        rows = names == name
        axes.plot(*true_m[rows].T, color=TRUE_COLOR, linewidth=1.8)
    axes.plot([], [], color=TRUE_COLOR, linewidth=1.8, label="ground truth")
    if network is not None:
        _draw_predictions(axes, network, _FAINT_COLOR, "network alone")
    _draw_predictions(axes, table, PREDICTED_COLOR, "prediction" if network is None else "network and map")
    axes.legend(loc="upper center", ncols=3, frameon=False)
    limits_m = box_around(table, *([] if network is None else [network]))
    axes.set(xlim=limits_m[0], ylim=limits_m[1], zlim=limits_m[2])
    for axis, name in zip((axes.xaxis, axes.yaxis, axes.zaxis), "xyz", strict=True):
        axis.set_major_locator(MaxNLocator(5))
        axis.set_label_text(f"{name} [m]")
        axis.labelpad = 8
    axes.set_box_aspect(np.ptp(limits_m, axis=1), zoom=1.08)

    beside = "" if network is None else f"; network alone {medians(network).removeprefix('median ')}"
    figure.suptitle(f"{title}\n{medians(table)} over {len(table.index)} frames{beside}", fontsize=12)
    bar = figure.add_subplot(grid[1])
    errors_deg = table.rotation_error_deg.cpu().numpy()
    has_pose = np.isfinite(errors_deg)
    top = round(max(1.0, float(np.percentile(errors_deg[has_pose], 95)) if has_pose.any() else 1.0), 1)
    image = bar.imshow(errors_deg[None], aspect="auto", cmap="viridis", vmin=0, vmax=top, interpolation="nearest")
    bar.set(yticks=[], xlabel="frame")
    figure.colorbar(image, ax=bar, label="rotation\nerror [°]", extend="max", ticks=[0, top], aspect=4)
    write_png(figure, path)


def _draw_predictions(axes: Any, table: PoseErrorTable, color: str, label: str) -> None:
    true_m, predicted_m = table.true_position_m.cpu().numpy(), table.predicted_position_m.cpu().numpy()
    for true, predicted in zip(true_m, predicted_m, strict=True):
        axes.plot(*np.stack((true, predicted)).T, color=color, linewidth=0.4, alpha=0.35)
    axes.scatter(*predicted_m.T, color=color, s=7, depthshade=False, label=label)


def box_around(*tables: PoseErrorTable) -> NDArray[np.floating]:
    """Where a plot of a split begins and ends along each axis: (3, 2), in metres."""
    all_m = torch.cat(
        [m.cpu() for table in tables for m in (table.true_position_m, table.predicted_position_m)]
    ).numpy()
    low_m, high_m = np.nanmin(all_m, axis=0), np.nanmax(all_m, axis=0)  # frames without a pose are NaN
    half_m = np.maximum((high_m - low_m) / 2, 0.25 * (high_m - low_m).max())  # a flat path still gets a box to lie in
    return np.stack(((low_m + high_m) / 2 - half_m, (low_m + high_m) / 2 + half_m), axis=1)


def medians(table: PoseErrorTable) -> str:
    """Say a split's median errors."""
    summary = summarize(table)
    return f"median {summary['position_error_m']:.3f} m, {summary['rotation_error_deg']:.2f}°"


def means(table: PoseErrorTable) -> str:
    """Say a split's mean errors."""
    summary = summarize(table)
    return f"mean {summary['position_error_mean_m']:.3f} m, {summary['rotation_error_mean_deg']:.2f}°"
