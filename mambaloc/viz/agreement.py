"""Whether a capture's poses agree with its images: by how far images are apart, by focal length, by depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from mambaloc.viz.png import write_png

Floats = NDArray[np.floating]

_GIVEN, _POSSIBLE, _ADJUSTED = "#2166ac", "#d9d9d9", "#1a9850"
_BEST = "#d73027"


def draw_agreement(
    bins: Sequence[tuple[str, float, float, float | None]],
    focal: tuple[Floats, Floats, float, float],
    depth: tuple[Floats, Floats, Floats] | None,
    path: Path,
    title: str,
    unit: str,
) -> None:
    """Draw which share of matches agrees with a capture's poses and its camera.

    Args:
        bins: of each range of baselines its name, and the share of matches that agrees, that could, and that agrees
            with adjusted poses, where there are some.
        focal: focal lengths in pixels (F,), the share at each (F,), the one given, and the best.
        depth: scales (S,), and the median error in pixels with focal lengths and with turns so scaled, (S,) each.
        path: the PNG to write.
        title: heads the plot.
        unit: of baselines.
    """
    count = 2 if depth is None else 3
    figure = Figure(figsize=(3.6 * count + 0.4, 3.7), layout="constrained")
    panels = figure.subplots(1, count)
    _draw_bins(panels[0], bins, unit)
    _draw_focal(panels[1], *focal)
    if depth is not None:
        _draw_depth(panels[2], *depth)
    for panel in panels:
        panel.grid(axis="y", color="#ececec", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.legend(
            frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3, columnspacing=1
        )
        panel.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=11)
    write_png(figure, path)


def _draw_bins(panel: Axes, bins: Sequence[tuple[str, float, float, float | None]], unit: str) -> None:
    names, share, possible, adjusted = zip(*bins, strict=True) if bins else ((), (), (), ())
    place, has_adjusted = np.arange(len(names)), bool(adjusted) and adjusted[0] is not None
    width, aside = (0.36, 0.19) if has_adjusted else (0.6, 0.0)
    panel.bar(place, possible, 0.82, color=_POSSIBLE, label="could agree")
    panel.bar(place - aside, share, width, color=_GIVEN, label="agree")
    if has_adjusted:
        panel.bar(place + aside, adjusted, width, color=_ADJUSTED, label="agree, adjusted")
    panel.set_xticks(place, names, fontsize=8)
    panel.set(ylim=(0, 1.0), xlabel=f"baseline [{unit}]")
    panel.set_title("matches, by baseline", fontsize=9, loc="left", color="#555555")
    panel.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))


def _draw_focal(panel: Axes, focal_px: Floats, share: Floats, given_px: float, best_px: float) -> None:
    panel.plot(focal_px, share, color=_GIVEN, linewidth=1.8)
    panel.axvline(given_px, color="#888888", linewidth=1.2, linestyle="--", label=f"given, {given_px:.0f} px")
    panel.axvline(best_px, color=_BEST, linewidth=1.2, label=f"best, {best_px:.0f} px")
    panel.set(ylim=(0, min(1.0, 1.3 * float(share.max()) + 0.02)), xlabel="focal length [px]")
    panel.set_title("matches that agree, by focal length", fontsize=9, loc="left", color="#555555")
    panel.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))


def _draw_depth(panel: Axes, scale: Floats, focal_px: Floats, turn_px: Floats) -> None:
    panel.plot(scale, focal_px, color=_GIVEN, linewidth=1.8, label="focal length")
    panel.plot(scale, turn_px, color=_ADJUSTED, linewidth=1.8, label="turns")
    panel.axvline(1.0, color="#888888", linewidth=1.2, linestyle="--")
    panel.set(ylim=(0, None), xlabel="over given")
    panel.set_title("median error by depth [px]", fontsize=9, loc="left", color="#555555")
