"""Figures as files."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mambaloc.files import atomic_file


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure, cut to what is on it, beside its place, and move it there whole."""
    with atomic_file(path) as partial:
        FigureCanvasAgg(figure).print_figure(partial, format="png", dpi=140, bbox_inches="tight", pad_inches=0.1)
