"""A matrix's results as files that people read: Markdown, CSV, and one page with a plot and tables to sort."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.figure import Figure as Canvas

from mambaloc.errors import InputError
from mambaloc.evaluation.intervals import BLOCK, LEVEL
from mambaloc.files import whole_folder
from mambaloc.matrix.store import Store, StoredCell
from mambaloc.matrix.summary import ERRORS, Difference, Figure, Row, differences, rows_of

_NAMES = {"position_error_m": "median position (m)", "rotation_error_deg": "median rotation (°)"}


def write_report(
    store: Path, out: Path, comparisons: Sequence[tuple[str, str, str]] = (), epoch: str = "last"
) -> tuple[list[Row], list[StoredCell]]:
    """Write ``report.md``, ``rows.csv`` and ``report.html``.

    Args:
        store: folder of a store.
        out: the folder, which must not be there yet.
        comparisons: of an axis, its label before, and after: differences on the same frames.
        epoch: ``last`` or ``best``.

    Returns:
        The rows, and the cells that failed.

    Raises:
        InputError: where no cell has ended, a comparison's label is none, or the folder cannot be written.
    """
    cells = list(Store.ended(store).values())
    rows, failed = rows_of(cells, epoch), [cell for cell in cells if cell.error is not None]
    if not rows:
        raise InputError(f"{store}: holds no result of the {epoch} epoch; run a matrix into it first")
    if out.exists():
        raise InputError(f"{out}: is there already; choose another folder with --out, or remove it")
    compared = {f"{axis}: {after} against {before}": differences(cells, axis, before, after, epoch)
                for axis, before, after in comparisons}  # fmt: skip
    with whole_folder(out, "choose another folder with --out") as folder:
        (folder / "report.md").write_text(_markdown(rows, compared, failed), encoding="utf-8")
        (folder / "report.html").write_text(_page(rows, compared, failed), encoding="utf-8")
        with (folder / "rows.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(_table(rows, str))
    return rows, failed


def _table(rows: Sequence[Row], number: Callable[[float], str]) -> list[list[str]]:
    """A header, and a line a row; a figure takes three cells: its mean and the ends of its interval."""
    header = [*rows[0].labels, "seeds"]
    for name in ERRORS:
        header += [_NAMES[name], "from", "to"]
    lines = [[*header, "training (s)", "trained on", "test frames", "beats retrieval", "data", "epoch"]]
    for row in rows:
        line = [*row.labels.values(), " ".join(row.seeds)]
        for name in ERRORS:
            line += [number(value) for value in (row.errors[name].mean, row.errors[name].low, row.errors[name].high)]
        beats = {None: "not measured", True: "yes", False: "no"}[row.beats_retrieval]
        lines.append(
            [*line, f"{row.train_s:.1f}", str(row.train_frames), str(row.test_frames), beats, row.data, row.selection]
        )
    return lines


def _differences_table(found: Sequence[Difference]) -> list[list[str]]:
    lines = [[*found[0].labels, *(_NAMES[name].replace("median", "difference of") for name in ERRORS)]]
    return lines + [[*each.labels.values(), *(_signed(each.errors[name]) for name in ERRORS)] for each in found]


def _signed(figure: Figure) -> str:
    sure = "" if figure.is_sure else ", may be none"
    return f"{figure.mean:+.3f} ({figure.low:+.3f} to {figure.high:+.3f}{sure})"


def _note(rows: Sequence[Row]) -> str:
    return (
        f"Means over seeds of medians over frames; intervals of {LEVEL:.0%} by bootstrap over blocks of {BLOCK} frames "
        "in a row: how much other frames of the same videos could change them, not other scenes nor more seeds. "
        f"Data: {'; '.join(dict.fromkeys(row.data for row in rows))}."
    )


def _failures(failed: Sequence[StoredCell]) -> list[str]:
    return [f"{' '.join(cell.labels.values())}: {cell.error}" for cell in failed]


def _markdown(rows: Sequence[Row], compared: dict[str, list[Difference]], failed: Sequence[StoredCell]) -> str:
    parts = ["# Results", _note(rows), _markdown_table(_table(rows, lambda value: f"{value:.3f}"))]
    for title, found in compared.items():
        parts += [f"## {title}", _markdown_table(_differences_table(found)) if found else "Never run both."]
    if failed:
        parts += ["## Failed", "\n".join(f"- {line}" for line in _failures(failed))]
    return "\n\n".join(parts) + "\n"


def _markdown_table(lines: list[list[str]]) -> str:
    escaped = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    rows = [f"| {' | '.join(line)} |" for line in escaped]
    return "\n".join([rows[0], "|" + "---|" * len(lines[0]), *rows[1:]])


def _page(rows: Sequence[Row], compared: dict[str, list[Difference]], failed: Sequence[StoredCell]) -> str:
    parts = [f"<p>{html.escape(_note(rows))}</p>", _plot(rows), _html_table(_table(rows, lambda v: f"{v:.3f}"))]
    for title, found in compared.items():
        table = _html_table(_differences_table(found)) if found else "<p>Never run both.</p>"
        parts += [f"<h2>{html.escape(title)}</h2>", table]
    if failed:
        items = "".join(f"<li>{html.escape(line)}</li>" for line in _failures(failed))
        parts += [f"<h2>Failed</h2><ul>{items}</ul>"]
    return _HTML.replace("BODY", "\n".join(parts))


def _html_table(lines: list[list[str]]) -> str:
    head = "".join(f"<th><button>{html.escape(cell)}</button></th>" for cell in lines[0])
    body = "".join(f"<tr>{''.join(map(_html_cell, line))}</tr>" for line in lines[1:])
    return f"<div><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _html_cell(text: str) -> str:
    is_number = text.replace(".", "", 1).isdecimal()
    return f"<td{' class=number' if is_number else ''}>{html.escape(text)}</td>"


def _plot(rows: Sequence[Row]) -> str:
    """Every row's figures with their intervals, as SVG."""
    canvas = Canvas(figsize=(10, 1.2 + 0.24 * len(rows)), layout="constrained")
    names = [" ".join(row.labels.values()) for row in rows]
    places = range(len(rows))[::-1]
    for axes, name in zip(canvas.subplots(1, len(ERRORS), sharey=True), ERRORS, strict=True):
        figures = [row.errors[name] for row in rows]
        means = [figure.mean for figure in figures]
        ends = [[max(0, f.mean - f.low) for f in figures], [max(0, f.high - f.mean) for f in figures]]
        axes.errorbar(means, places, xerr=ends, fmt="o", ms=4, lw=1, color="#1d4ed8")
        axes.set_xlabel(_NAMES[name])
        axes.set_xlim(left=0)
        axes.grid(axis="x", color="#ddd")
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.set_yticks(places, names, fontsize=8)
        axes.tick_params(axis="y", length=0)
    text = io.StringIO()
    canvas.savefig(text, format="svg", metadata={"Date": None})
    return f"<figure>{text.getvalue()[text.getvalue().index('<svg') :]}</figure>"


_HTML = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Results</title>
<style>
  body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; padding: 0 1rem; max-width: 80rem; color: #1b1f24 }
  p { max-width: 60rem }
  div { overflow-x: auto }
  table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px }
  th, td { padding: .3rem .6rem; border-bottom: 1px solid #ddd; text-align: left; white-space: nowrap }
  td.number { text-align: right }
  th button { font: inherit; font-weight: 600; background: none; border: 0; padding: 0; cursor: pointer }
  figure { margin: 1rem 0 } svg { max-width: 100%; height: auto }
</style>
<h1>Results</h1>
BODY
<script>
  // A click on a column's name sorts by it, another one the other way.
  for (const button of document.querySelectorAll("th button")) button.onclick = () => {
    const column = button.parentElement.cellIndex, body = button.closest("table").tBodies[0];
    const turn = button.dataset.turn = button.dataset.turn === "1" ? "-1" : "1";
    const value = (row) => row.cells[column].textContent;
    const order = (a, b) => parseFloat(a) - parseFloat(b) || a.localeCompare(b);
    body.append(...[...body.rows].sort((a, b) => turn * order(value(a), value(b))));
  };
</script>
</html>
"""
