"""Results as a table in the terminal."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table


def print_table(results: Sequence[dict[str, Any]]) -> None:
    """Print what :func:`~mambaloc.evaluation.evaluate_checkpoint` returned, a row a checkpoint."""
    data = results[0]["data"]
    benchmark = "official split" if data["official_split"] else "not an official benchmark split"
    table = _table(f"{data['dataset']}/{data['scene']}: {results[0]['count']} test frames, {benchmark}")
    for column in ("median", "mean", "worst", "5cm 5°", "25cm 2°", "50cm 5°"):
        table.add_column(column, justify="right", no_wrap=True)
    for result in results:
        chosen = result["selection"].split(":")[0]
        table.add_row(f"{chosen} (epoch {result['training']['epoch']})", *_cells(result["metrics"]))
        if both := result.get("network_and_map"):
            table.add_row(f"{chosen} and map", *_cells(both["metrics"]))
    in_map = results[0].get("map")
    if in_map:
        table.add_row("map", *_cells(in_map["metrics"]))
    for name, reference in results[0]["references"].items():
        table.add_row(f"[dim]{name.replace('_', ' ')}", f"[dim]{_medians(reference)}", *[""] * 5)
    console = Console(highlight=False)
    console.print(table)
    for result in results:
        if ":" in result["selection"]:
            console.print(result["selection"], soft_wrap=True)
    if in_map:
        console.print(_map_line(in_map), soft_wrap=True)
    if clock := results[-1]["training"]["wall_clock"]:
        console.print(_wall_clock_line(clock), soft_wrap=True)
    skipped = {part: sum(counts.values()) for part, counts in data["skipped"].items() if counts}
    if skipped:
        console.print("skipped frames: " + ", ".join(f"{part} {count}" for part, count in skipped.items()))


def print_scenes(results: dict[str, dict[str, Any]]) -> None:
    """Print what :func:`~mambaloc.evaluation.evaluate_scenes` returned, a row a scene, and the mean over them."""
    first = next(iter(results.values()))
    frames = sum(each["count"] for each in results.values())
    table = _table(f"{first['selection'].split(':')[0]} (epoch {first['training']['epoch']}): {frames} test frames")
    for name in ("median", "mean", "25cm 2°", "50cm 5°", "recognised"):
        table.add_column(name, justify="right", no_wrap=True)
    rows = {name: {**each["metrics"], "recognised": each["recognised"]} for name, each in results.items()}
    mean = {key: statistics.fmean(row[key] for row in rows.values()) for key in next(iter(rows.values()))}
    for name, row in {**rows, "[bold]mean of scenes": mean}.items():
        shares = (f"{row[key]:.0%}" for key in ("recall_25cm_2deg", "recall_50cm_5deg", "recognised"))
        table.add_row(name, _medians(row), _means(row), *shares)
    Console(highlight=False).print(table)


def _table(title: str) -> Table:
    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 0)
    )
    table.add_column("", no_wrap=True)
    return table


def _means(metrics: dict[str, float]) -> str:
    return _pose(metrics["position_error_mean_m"], metrics["rotation_error_mean_deg"])


def _cells(metrics: dict[str, float]) -> list[str]:
    recalls = (f"{metrics[name]:.0%}" for name in ("recall_5cm_5deg", "recall_25cm_2deg", "recall_50cm_5deg"))
    return [_medians(metrics), _means(metrics), f"{metrics['position_error_worst_m']:.2f}m", *recalls]


def _medians(metrics: dict[str, float]) -> str:
    return _pose(metrics["position_error_m"], metrics["rotation_error_deg"])


def _pose(position_m: float, rotation_deg: float) -> str:
    """Both as wide as fits beside the other columns in a terminal of 80."""
    return f"{position_m:.{3 if position_m < 10 else 2}f} m {rotation_deg:5.{2 if rotation_deg < 100 else 1}f}°"


def _map_line(in_map: dict[str, Any]) -> str:
    metrics = in_map["metrics"]
    return (
        f"map: {metrics['accepted']:.1%} of its poses accepted, of those {metrics['accepted_and_wrong']:.1%} wrong "
        f"(over 0.2 m or 5°); {metrics['query_cpu_ms']:.0f} ms of CPU time an image, {in_map['mib']:.2f} MiB"
    )


def _wall_clock_line(clock: dict[str, Any]) -> str:
    line = "training {train_s:.1f} s, validation {validation_s:.1f} s, set-up {setup_s:.1f} s".format(**clock)
    if clock["reach"]:
        sought = ", ".join(f"{name} {value:g}" for name, value in clock["reach"].items())
        reached = "never" if clock["reached_s"] is None else f"after {clock['reached_s']:.1f} s"
        line += f"; validation {sought} reached {reached}"
    return line
