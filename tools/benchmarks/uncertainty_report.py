"""What :mod:`uncertainty_methods` measured: tables in the terminal, coverage and sparsification drawn, JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from torch import Tensor
from uncertainty_methods import (
    LEVELS,
    REJECTED,
    UncertaintyMethod,
    UncertaintyReport,
    change_by_rejection,
    median_of_surest,
    ood_auroc,
    rank_correlation,
)

from mambaloc.benchmark.report import new_table
from mambaloc.files import atomic_file, writing
from mambaloc.viz.curves import COLORS, finish
from mambaloc.viz.png import write_png

_KEPT = np.linspace(1, 0.1, 46)
_ERRORS = ("position", "rotation")


def print_certainty(found: Sequence[UncertaintyReport], machine: str) -> None:
    """Print how the ways compare, and what the radii hold; means over the checkpoints."""
    console = Console(highlight=False)
    columns = ("passes", "rank m", "rank °", "median m", "median °", "out of place")
    table = new_table("How sure a pose is", "estimate", *columns)
    for name, figures in compared(found).items():
        ranks = (f"{figures[f'{of}_rank_correlation']:.2f}" for of in _ERRORS)
        changes = (f"{figures[f'{of}_change']:+.1%}" for of in _ERRORS)
        auroc = "" if figures["told_apart"] is None else f"{figures['told_apart']:.3f}"
        table.add_row(name, str(figures["passes"]), *ranks, *changes, auroc)
    console.print(table)
    explained = "rank: correlation of scores' ranks with errors'"
    rejected = f"median: what leaving out the {REJECTED:.0%} least sure frames changes it by"
    console.print(f"{explained}; {rejected}; out of place: area under the ROC curve", soft_wrap=True)
    table = new_table("Test frames within the radii", "asked", "position", "rotation", "radius m", "°")
    for level in LEVELS:
        shares = np.mean([each.coverage[level] for each in found], axis=0)
        radii = np.mean([each.radii[level] for each in found], axis=0)
        table.add_row(f"{level:.0%}", *(f"{share:.1%}" for share in shares), f"{radii[0]:.3f}", f"{radii[1]:.2f}")
    console.print(table)
    first = found[0]
    flagged = f"unfamiliar: {np.mean([_flagged(each.unfamiliarity) for each in found]):.1%} of the test frames"
    if images_elsewhere := len(first.unfamiliarity_elsewhere):
        there = np.mean([_flagged(each.unfamiliarity_elsewhere) for each in found])
        flagged += f", {there:.1%} of {images_elsewhere} images of another place"
    console.print(flagged, soft_wrap=True)
    counts = f"{len(first.position_error_m)} test frames, {first.held_out_frames} held out of training to calibrate on"
    console.print(f"{found[0].where}; {counts}; means over {len(found)} checkpoint(s); {machine}", soft_wrap=True)


def compared(found: Sequence[UncertaintyReport]) -> dict[str, dict[str, Any]]:
    """Figures of each way, means over the checkpoints: how scores rank errors, what rejecting the least sure is worth.

    ``ood_auroc`` is None where there were no images of another place.
    """
    figures = {}
    for number, way in enumerate(found[0].ways):
        of_each = [_figures(each, each.ways[number]) for each in found]
        means = {
            name: None if value is None else float(np.mean([of[name] for of in of_each]))
            for name, value in of_each[0].items()
        }
        figures[way.name] = {"passes": way.passes, **means}
    return figures


def write_certainty(found: Sequence[UncertaintyReport], folder: Path, machine: str) -> None:
    """Write ``uncertainty.json`` and ``uncertainty.png`` into a folder.

    Raises:
        InputError: where it cannot be written.
    """
    content = {
        "where": found[0].where,
        "machine": machine,
        "compared": compared(found),
        "checkpoints": [
            {
                "checkpoint": each.name,
                "held_out_frames": each.held_out_frames,
                "test_frames": len(each.position_error_m),
                "coverage": each.coverage,
                "radii": each.radii,
                "unfamiliar": _flagged(each.unfamiliarity),
                "unfamiliar_elsewhere": _flagged(each.unfamiliarity_elsewhere),
            }
            for each in found
        ],
    }
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_file(folder / "uncertainty.json") as partial:
            partial.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        _draw(found, folder / "uncertainty.png")


def _draw(found: Sequence[UncertaintyReport], path: Path) -> None:
    """Coverage and familiarity above, sparsification below."""
    figure = Figure(figsize=(10, 8), layout="constrained")
    (coverage, familiarity), below = figure.subplots(2, 2)
    _draw_coverage(coverage, found)
    _draw_familiarity(familiarity, found)
    for axes, of in zip(below, _ERRORS, strict=True):
        _draw_sparsification(axes, found, of)
    checkpoints = f"{len(found)} checkpoint{'s' if len(found) > 1 else ''}"
    figure.suptitle(f"{found[0].where}, {checkpoints}", fontsize=11)
    handles, names = below[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False)
    for axes in (coverage, familiarity, *below):
        finish(axes)
    write_png(figure, path)


def _draw_coverage(axes: Axes, found: Sequence[UncertaintyReport]) -> None:
    axes.plot([0.4, 1], [0.4, 1], color="#9ca3af", linewidth=0.8, linestyle=":")
    shares = np.array([[each.coverage[level] for level in LEVELS] for each in found])
    for color, column, of in zip(COLORS[1:], (0, 1), _ERRORS, strict=False):
        for one in shares[..., column] if len(found) > 1 else ():
            axes.plot(LEVELS, one, color=color, linewidth=0.6, alpha=0.4)
        axes.plot(LEVELS, shares[..., column].mean(axis=0), color=color, linewidth=1.6, marker="o", ms=4, label=of)
    axes.set(xlim=(0.45, 0.95), ylim=(0.4, 1.02), xlabel="share asked", ylabel="share of test frames within the radius")
    axes.legend(frameon=False, loc="upper left")


def _draw_familiarity(axes: Axes, found: Sequence[UncertaintyReport]) -> None:
    here = np.concatenate([each.unfamiliarity.numpy() for each in found])
    there = np.concatenate([each.unfamiliarity_elsewhere.numpy() for each in found])
    bins = np.linspace(0, 1.05 * max([1.0, here.max(), *there]), 40)
    drawn = [(here, "test frames", COLORS[1])] + ([(there, "another place", COLORS[2])] if len(there) else [])
    for values, name, color in drawn:
        axes.hist(
            values, bins.tolist(), weights=np.full(len(values), 1 / len(values)), color=color, alpha=0.65, label=name
        )
    axes.axvline(1, color="#374151", linewidth=1, linestyle="--")
    axes.set(xlabel="unfamiliarity (flagged right of the dashed line)", ylabel="share of images")
    axes.legend(frameon=False, loc="upper left")


def _draw_sparsification(axes: Axes, found: Sequence[UncertaintyReport], of: str) -> None:
    """Median error of those kept, over that of all, as the least sure are left out; dotted, if the worst were."""

    def curve(score_of: Callable[[UncertaintyReport], Tensor]) -> np.ndarray:
        curves = []
        for each in found:
            error = _error(each, of)
            kept = torch.stack([median_of_surest(score_of(each), error, share) for share in _KEPT])
            curves.append((kept / error.double().quantile(0.5)).numpy())
        return np.mean(curves, axis=0)

    rejected = 1 - _KEPT
    for number, (color, way) in enumerate(zip(COLORS[1:], found[0].ways, strict=False)):
        width = 2.0 if number == 0 else 1.1
        scores = curve(lambda each, number=number: getattr(each.ways[number], of))  # type: ignore[misc]
        axes.plot(rejected, scores, color=color, linewidth=width, label=way.name)
    perfect = curve(lambda each: _error(each, of))
    axes.plot(rejected, perfect, color="#374151", linewidth=1, linestyle=":", label="the errors themselves")
    axes.axhline(1, color="#9ca3af", linewidth=0.8)
    axes.axvline(REJECTED, color="#9ca3af", linewidth=0.8, linestyle="--")
    axes.set(xlim=(0, 0.9), xlabel="share of test frames rejected", ylabel=f"median {of} error, over that of all")
    axes.set_ylim(bottom=0)


def _figures(each: UncertaintyReport, way: UncertaintyMethod) -> dict[str, float | None]:
    figures: dict[str, float | None] = {}
    for of in _ERRORS:
        score, error = getattr(way, of), _error(each, of)
        figures[f"{of}_rank_correlation"] = rank_correlation(score, error)
        figures[f"{of}_change"] = change_by_rejection(score, error)
    return {**figures, "told_apart": ood_auroc(way.position, way.elsewhere) if len(way.elsewhere) else None}


def _error(each: UncertaintyReport, of: str) -> Tensor:
    return each.position_error_m if of == "position" else each.rotation_error_deg


def _flagged(unfamiliarity: Tensor) -> float | None:
    """Share over 1; None of no images."""
    return (unfamiliarity > 1).double().mean().item() if len(unfamiliarity) else None
