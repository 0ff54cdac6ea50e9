"""A bundle's deviations as a table."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from mambaloc.runtime.bundle import Deviation


def print_deviations(deviations: Sequence[Deviation]) -> None:
    """Print a row a model."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for column in ("model", "mm", "deg", "ms", ""):
        table.add_column(column, justify="left" if column in ("model", "") else "right")
    for each in deviations:
        numbers = (f"{each.position_mm:.3g}", f"{each.rotation_deg:.2g}", f"{each.latency_ms:.1f}")
        table.add_row(each.file, *numbers, "within bounds" if each.within else "DEVIATES")
    Console(highlight=False).print(table)
