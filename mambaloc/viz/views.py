"""A contact sheet of views that were rendered at new poses: beside real frames, and where real frames are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mambaloc.synthesis import PosedDepth, Quality, Views
from mambaloc.viz.png import write_png

_COLUMNS = 6
_BESIDE = 3  # views below each frame
_PANEL_IN = 1.6
_GAP = 0.3  # of a strip's height
_TIGHT = {"left": 0.0, "right": 1.0, "bottom": 0.0, "top": 1.0, "wspace": 0.04, "hspace": 0.05}


def draw_views(source: PosedDepth, views: Views, quality: Quality, path: Path, title: str) -> None:
    """Draw frames above the views nearest to them, and held-out frames above the views at their poses.

    Args:
        source: the frames that views were made from.
        views: made from them.
        quality: of held-out frames.
        path: the PNG to write.
        title: heads the plot.
    """
    height, width = source.images.shape[2:]
    rows = np.linspace(0, len(source) - 1, min(_COLUMNS, len(source))).round().astype(int)
    held = np.linspace(0, len(quality.real) - 1, min(_COLUMNS, len(quality.real))).round().astype(int)
    near = np.argsort(source.apart(views.world_from_cam), axis=0, kind="stable")[:_BESIDE, rows]
    strips = [source.images[rows], *(views.images[each] for each in near), quality.real[held], quality.views[held]]
    strip_in = _PANEL_IN * height / width
    figure = Figure(figsize=(_PANEL_IN * _COLUMNS, strip_in * (len(strips) + _GAP)))
    ratios = [1.0] * (_BESIDE + 1) + [_GAP, 1.0, 1.0]
    panels = figure.subplots(len(ratios), _COLUMNS, squeeze=False, height_ratios=ratios, gridspec_kw=_TIGHT)
    for axis in panels[_BESIDE + 1]:
        axis.set_axis_off()
    panels = np.delete(panels, _BESIDE + 1, axis=0)
    for strip, axes in zip(strips, panels, strict=True):
        for axis in axes:
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        for image, axis in zip(strip, axes, strict=False):
            axis.imshow(image.transpose(1, 2, 0))
    known = panels[-2:]
    for axes, name in zip(panels, ("real", *["view"] * _BESIDE, "real", "view"), strict=True):
        axes[0].set_ylabel(name, fontsize=9)
    _head(panels[0][0], f"At new poses: real frames, and the {_BESIDE} views nearest to each")
    _head(known[0][0], f"At poses of real frames, made from others: {quality.describe()}")
    for axis, row in zip(known[1], held, strict=False):
        axis.set_xlabel(f"{quality.correlations[row]:.2f}, holes {quality.hole_share[row]:.0%}", fontsize=8)
    figure.suptitle(title, fontsize=12, y=1 + 0.45 / figure.get_figheight())
    write_png(figure, path)


def _head(axis: Axes, text: str) -> None:
    axis.set_title(text, fontsize=10, loc="left", color="#333333", pad=5)
