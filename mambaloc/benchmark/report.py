"""Measurements as tables in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median

from rich import box
from rich.console import Console
from rich.table import Table

from mambaloc import provenance
from mambaloc.benchmark.deployment import Deployment, speed_up
from mambaloc.benchmark.latency import Latency, forward_flops
from mambaloc.benchmark.sizes import UNEXPLAINED, Size
from mambaloc.export.quantization import LARGEST_LOSS
from mambaloc.models.weights import mib

NOT_SHIPPED = f"\n* loses more than {LARGEST_LOSS:.0%} of its median error, so no bundle holds it"


def print_sizes(sizes: Sequence[Size]) -> None:
    """Print a row a system and GIS: ours, as published, and the paper's figure; and counts of published programs."""
    table = new_table("Parameters", "system", "gis", "ours", "MiB", "published", "MiB", "paper MiB")
    notes = []
    for size in sizes:
        paper = "" if size.paper_mib is None else f"{size.paper_mib:.2f}"
        if note := UNEXPLAINED.get((size.system, size.gis)):
            notes.append(f"* {size.system}, gis {size.gis}: the paper's {paper} is unexplained; {note}")
            paper += "*"
        cells = (f"{size.shipped:,}", f"{mib(size.shipped):.2f}", f"{size.published:,}", f"{mib(size.published):.2f}")
        table.add_row(size.system, size.gis, *cells, paper)
        if size.program is not None:
            notes.append(f"{size.system}: counted in the published program itself: {size.program:,}")
    console = Console(highlight=False)
    console.print(table)
    for line in notes + _replaced(sizes):
        console.print(line, soft_wrap=True)


def _replaced(sizes: Sequence[Size]) -> list[str]:
    """What makes the difference of shipped and published, a line for all systems of the same items."""
    systems: dict[tuple[tuple[str, int], ...], list[str]] = {}
    for size in sizes:
        if size.replaced:
            systems.setdefault(tuple(size.replaced.items()), []).append(size.system)
    return [
        f"{', '.join(dict.fromkeys(names))}: " + ", ".join(f"{item} {count:+,}" for item, count in items)
        for items, names in systems.items()
    ]


def print_latencies(latencies: Sequence[Latency], image_size: int, machine: str) -> None:
    """Print a row a system, measure and batch: medians, the ratio, its spread; then operations."""
    title = f"Milliseconds without and with GIS, {image_size} px, {machine}"
    table = new_table(title, "system", "what", "batch", "without ms", "with ms", "ratio", "± IQR")
    for each in latencies:
        times = (f"{median(s) * 1000:.1f}" for s in (each.without_s, each.with_s))
        table.add_row(each.system, each.what, str(each.batch), *times, f"{each.ratio:.3f}", f"{each.spread:.3f}")
    flops = new_table("Forward pass of one image", "system", "GFLOP without", "GFLOP with", "ratio")
    for name in dict.fromkeys(each.system for each in latencies):
        without, with_gis = (forward_flops(name, gis, image_size) for gis in ("none", "gis"))
        flops.add_row(name, f"{without / 1e9:.3f}", f"{with_gis / 1e9:.3f}", f"{with_gis / without:.3f}")
    console = Console(highlight=False)
    console.print(table)
    console.print(flops)
    console.print("Products and convolutions; LSTMs and element-wise operations are not counted.")


def print_deployments(deployments: Sequence[Deployment], threads: int, machine: str) -> None:
    """Print a row a system and form: size, latency with its spread, how much faster than the first row, errors."""
    table = new_table("Trained systems on a device", "system", "form", "MiB", "ms", "± IQR", "times faster", "m", "°")
    for each in deployments:
        times = (f"{1000 * s:.2f}" for s in (median(each.latency_s), each.spread_s))
        errors = (f"{each.position_error_m:.3f}", f"{each.rotation_error_deg:.2f}")
        ratio = "{:.1f} ± {:.1f}".format(*speed_up(deployments, each))
        form = each.form if each.fits else f"{each.form}*"
        table.add_row(_run(each.name), form, f"{each.size / 2**20:.2f}", *times, ratio, *errors)
    console = Console(highlight=False)
    console.print(table)
    count, versions = len(deployments[0].latency_s), provenance.versions()
    packages = ", ".join(f"{name} {versions[name]}" for name in ("torch", "onnxruntime"))
    console.print(
        f"{threads} threads, {count} times, one image after another: medians ± quartile range", soft_wrap=True
    )
    console.print(f"m and °: medians over {deployments[0].frames} test frames; {packages}", soft_wrap=True)
    console.print(f"{machine}{'' if all(each.fits for each in deployments) else NOT_SHIPPED}", soft_wrap=True)


def _run(source: str) -> str:
    """A training run's folder for its checkpoint's path; another name as it is."""
    path = Path(source)
    return path.parent.parent.name if path.suffix == ".ckpt" else source


def new_table(title: str, *columns: str) -> Table:
    """Begin a table; columns of words to the left, of numbers to the right."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for column in columns:
        text = column in ("system", "gis", "what", "form", "scene", "part", "way")
        table.add_column(column, justify="left" if text else "right", no_wrap=True)
    return table
