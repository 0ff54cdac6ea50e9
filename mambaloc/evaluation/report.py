"""Results as a table in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table


def print_table(results: Sequence[dict[str, Any]]) -> None:
    """Print what :func:`~mambaloc.evaluation.evaluate_checkpoint` returned, a row a checkpoint."""
    data = results[0]["data"]
    benchmark = "official split" if data["official_split"] else "not an official benchmark split"
    table = Table(
        title=f"{data['dataset']}/{data['scene']}: {results[0]['count']} test frames, {benchmark}",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 0),
    )
    table.add_column("", no_wrap=True)
    for column in ("median", "mean", "5cm 5°", "25cm 2°", "50cm 5°"):
        table.add_column(column, justify="right", no_wrap=True)
    for result in results:
        metrics = result["metrics"]
        table.add_row(
            f"{result['selection'].split(':')[0]} (epoch {result['training']['epoch']})",
            f"{metrics['position_error_m']:.3f} m {metrics['rotation_error_deg']:5.2f}°",
            f"{metrics['position_error_mean_m']:.3f} m {metrics['rotation_error_mean_deg']:5.2f}°",
            *(f"{metrics[name]:.0%}" for name in ("recall_5cm_5deg", "recall_25cm_2deg", "recall_50cm_5deg")),
        )
    for name, reference in results[0]["references"].items():
        medians = f"{reference['position_error_m']:.3f} m {reference['rotation_error_deg']:5.2f}°"
        table.add_row(f"[dim]{name.replace('_', ' ')}", f"[dim]{medians}", *[""] * 4)
    console = Console(highlight=False)
    console.print(table)
    for result in results:
        if ":" in result["selection"]:
            console.print(result["selection"], soft_wrap=True)
    if clock := results[-1]["training"]["wall_clock"]:
        console.print(_wall_clock_line(clock), soft_wrap=True)
    skipped = {part: sum(counts.values()) for part, counts in data["skipped"].items() if counts}
    if skipped:
        console.print("skipped frames: " + ", ".join(f"{part} {count}" for part, count in skipped.items()))


def _wall_clock_line(clock: dict[str, Any]) -> str:
    line = "training {train_s:.1f} s, validation {validation_s:.1f} s, set-up {setup_s:.1f} s".format(**clock)
    if clock["reach"]:
        sought = ", ".join(f"{name} {value:g}" for name, value in clock["reach"].items())
        reached = "never" if clock["reached_s"] is None else f"after {clock['reached_s']:.1f} s"
        line += f"; validation {sought} reached {reached}"
    return line
