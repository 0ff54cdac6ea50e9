"""Results as a table in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table


def print_table(results: Sequence[dict[str, Any]]) -> None:
    """Print what :func:`~mambaloc.evaluation.evaluate_checkpoint` returned, a row a checkpoint."""
    data = results[0]["data"]
    label = f"{data['dataset']}/{data['scene']}, {results[0]['count']} test frames"
    if not data["official_split"]:
        label += " (not the benchmark's official split)"
    table = Table(title=label, title_justify="left")
    for column in ("checkpoint", "epoch", "median", "mean", "5 cm 5°", "25 cm 2°", "50 cm 5°", "training"):
        table.add_column(column, justify="left" if column == "checkpoint" else "right")
    for result in results:
        metrics, training = result["metrics"], result["training"]
        clock = training["wall_clock"]
        table.add_row(
            result["selection"],
            str(training["epoch"]),
            f"{metrics['position_error_m']:.3f} m  {metrics['rotation_error_deg']:.2f}°",
            f"{metrics['position_error_mean_m']:.3f} m  {metrics['rotation_error_mean_deg']:.2f}°",
            *(f"{metrics[name]:.1%}" for name in ("recall_5cm_5deg", "recall_25cm_2deg", "recall_50cm_5deg")),
            f"{clock['train_s']:.1f} s" if clock else "-",
        )
    Console().print(table)
    skipped = {part: sum(counts.values()) for part, counts in data["skipped"].items() if counts}
    if skipped:
        Console().print("skipped frames: " + ", ".join(f"{part} {count}" for part, count in skipped.items()))
