"""A contact sheet of views that were rendered at new poses: beside real frames, and where real frames are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mambaloc.synthesis import PosedDepth, Quality, Views
from mambaloc.viz.png import write_png

_COLUMNS = 6
_BESIDE = 3  # views below each frame
_PANEL_IN = 1.6
_GAP = 0.3  # of a strip's height
_TIGHT = {"left": 0.0, "right": 1.0, "bottom": 0.0, "top": 1.0, "wspace": 0.04, "hspace": 0.05}


@dataclass(frozen=True)
class _Group:
    """Strips of images (K, 3, h, w) below each other, each with a name, and a note below each column."""

    heading: str
    names: Sequence[str]
    strips: Sequence[NDArray[np.uint8]]
    notes: Sequence[str] = ()


def draw_views(source: PosedDepth, views: Views | None, quality: Quality, path: Path, title: str) -> None:
    """Draw frames above the views nearest to them, and held-out frames above the views at their poses.

    Args:
        source: the frames that views were made from.
        views: made from them; the held-out frames alone are drawn unless given.
        quality: of held-out frames.
        path: the PNG to write.
        title: heads the plot.
    """
    groups = [_at_real_poses(quality)] if views is None else [_at_new_poses(source, views), _at_real_poses(quality)]
    height, width = source.images.shape[2:]
    ratios: list[float] = []  # a row of panels each, gaps between groups among them
    for group in groups:
        ratios += [*([_GAP] if ratios else []), *[1.0] * len(group.strips)]
    figure = Figure(figsize=(_PANEL_IN * _COLUMNS, _PANEL_IN * height / width * sum(ratios)))
    panels = figure.subplots(len(ratios), _COLUMNS, squeeze=False, height_ratios=ratios, gridspec_kw=_TIGHT)
    for axis in panels[[ratio < 1 for ratio in ratios]].flat:
        axis.set_axis_off()
    rows = iter(panels[[ratio == 1 for ratio in ratios]])
    for group in groups:
        _draw_group(group, [next(rows) for _ in group.strips])
    figure.suptitle(title, fontsize=12, y=1 + 0.45 / figure.get_figheight())
    write_png(figure, path)


def _at_new_poses(source: PosedDepth, views: Views) -> _Group:
    rows = _spread(len(source))
    near = np.argsort(source.distance(views.world_from_cam), axis=0, kind="stable")[:_BESIDE, rows]
    return _Group(
        f"At new poses: real frames, and the {_BESIDE} views nearest to each",
        ("real", *["view"] * len(near)),
        (source.images[rows], *(views.images[each] for each in near)),
    )


def _at_real_poses(quality: Quality) -> _Group:
    rows = _spread(len(quality.real))
    return _Group(
        f"At poses of real frames, made from others: {quality.describe()}",
        ("real", "view"),
        (quality.real[rows], quality.views[rows]),
        [f"{quality.correlations[row]:.2f}, holes {quality.hole_share[row]:.0%}" for row in rows],
    )


def _spread(count: int) -> NDArray[np.int64]:
    return np.linspace(0, count - 1, min(_COLUMNS, count)).round().astype(int)


def _draw_group(group: _Group, panels: Sequence[Sequence[Axes]]) -> None:
    for name, strip, axes in zip(group.names, group.strips, panels, strict=True):
        for axis in axes:
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        for image, axis in zip(strip, axes, strict=False):
            axis.imshow(image.transpose(1, 2, 0))
        axes[0].set_ylabel(name, fontsize=9)
    panels[0][0].set_title(group.heading, fontsize=10, loc="left", color="#333333", pad=5)
    for axis, note in zip(panels[-1], group.notes, strict=False):
        axis.set_xlabel(note, fontsize=8)
