"""A sweep's results as files that people read: one page, Markdown with its plots, and every table as CSV and LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import geometric_mean, mean, stdev

from mambaloc.errors import InputError
from mambaloc.evaluation.intervals import BLOCK, LEVEL
from mambaloc.files import atomic_folder
from mambaloc.sweep.formats import Section, as_csv, as_latex, as_markdown, as_page, as_svg
from mambaloc.sweep.paper import paper_tables
from mambaloc.sweep.plots import NAMES, plots_of
from mambaloc.sweep.store import Store, StoredTrial
from mambaloc.sweep.summary import ERRORS, Difference, Estimate, Row, differences, history, rows_of

Table = list[list[str]]


def write_report(
    store: Path,
    out: Path,
    comparisons: Sequence[tuple[str, str, str]] = (),
    epoch: str = "last",
    reach_m: float | None = None,
) -> tuple[list[Row], list[StoredTrial]]:
    """Write ``report.html``, ``report.md`` with ``plots/``, and ``tables/``: results, differences, the paper's tables.

    Args:
        store: folder of a store.
        out: the folder, which must not be there yet.
        comparisons: of an axis, its label before, and after: differences on the same frames. Plots show the first
            one's labels by colour.
        epoch: ``last`` or ``best``.
        reach_m: position error whose training seconds are reported; retrieval's, where that was measured, unless given.

    Returns:
        The rows, and the trials that failed.

    Raises:
        InputError: where no trial has ended, a comparison's label is unknown, or the folder cannot be written.
    """
    trials = list(Store.ended(store).values())
    rows, failed = rows_of(trials, epoch), [trial for trial in trials if trial.error is not None]
    if not rows:
        raise InputError(f"{store}: contains no result of the {epoch} epoch; run a sweep into it first")
    if out.exists():
        raise InputError(f"{out}: already exists; choose another folder with --out, or remove it")
    sections = [_results(rows), *_with_maps(rows)]
    for number, (axis, before, after) in enumerate(comparisons):
        found = differences(trials, axis, before, after, epoch)
        sections.append(_compared(f"difference_{number + 1}", axis, before, after, found))
    plots = plots_of(rows, comparisons[0][0] if comparisons else None)
    sections += [Section("", plot.title, plot.text, plot=as_svg(plot.figure)) for plot in plots]
    sections += [_times(rows, reach_m), _references(rows)]
    sections += [
        Section(each.name, f"The paper's table: {each.title}", "", each.lines, each.footnotes, folded=not each.measured)
        for each in paper_tables(trials, epoch)
    ]
    if failed:
        sections.append(_failures(failed))
    with atomic_folder(out, "choose another folder with --out") as folder:
        _write(folder, _introduction(rows, failed), sections)
    return rows, failed


def _write(folder: Path, introduction: str, sections: Sequence[Section]) -> None:
    for name in ("plots", "tables"):
        (folder / name).mkdir()
    for section in sections:
        if section.plot:
            (folder / "plots" / f"{section.anchor}.svg").write_text(section.plot, encoding="utf-8")
        if section.name and section.table:
            (folder / "tables" / f"{section.name}.csv").write_text(as_csv(section.table), encoding="utf-8")
            (folder / "tables" / f"{section.name}.tex").write_text(as_latex(section), encoding="utf-8")
    (folder / "report.md").write_text(as_markdown(introduction, sections), encoding="utf-8")
    (folder / "report.html").write_text(as_page(introduction, sections), encoding="utf-8")


def _introduction(rows: Sequence[Row], failed: Sequence[StoredTrial]) -> str:
    runs = sum(len(row.trials) for row in rows)
    trials = [trial for row in rows for trial in row.trials]
    commits = ", ".join(sorted({str(trial["training"]["commit"])[:7] for trial in trials}))
    devices = ", ".join(sorted({trial["training"]["device"] for trial in trials}))
    failures = f", {len(failed)} more failed" if failed else ""
    data = "; ".join(dict.fromkeys(row.data for row in rows))
    return f"{runs} trainings{failures}; commit {commits}; {devices}. Data: {data}."


def _results(rows: Sequence[Row]) -> Section:
    text = (
        f"Means over seeds of medians over frames; intervals of {LEVEL:.0%} by bootstrap over blocks of {BLOCK} frames "
        "in a row: how much other frames of the same videos could change them, not other scenes nor more seeds."
    )
    header = [*rows[0].labels, "seeds"]
    for name in ERRORS:
        header += [NAMES[name], "from", "to"]
    table = [[*header, "training (s)", "steps", "trained on", "test frames", "beats retrieval", "data", "epoch"]]
    for row in rows:
        line = [*row.labels.values(), " ".join(row.seeds)]
        for name in ERRORS:
            line += [f"{value:.3f}" for value in (row.errors[name].mean, row.errors[name].low, row.errors[name].high)]
        beats = {None: "not measured", True: "yes", False: "no"}[row.beats_retrieval]
        counts = [f"{mean(row.train_s):.1f}", f"{mean(row.steps):.0f}", str(row.train_frames), str(row.test_frames)]
        table.append([*line, *counts, beats, row.data, row.selection])
    return Section("results", "Results", text, table)


def _with_maps(rows: Sequence[Row]) -> list[Section]:
    """The networks beside a map; nothing where none was built."""
    text = (
        "The map's pose where it is accepted, otherwise the network's. Means over seeds of the networks. A map has no "
        "such seed; each image was localized with one seed of RANSAC. Wrong: by more than 0.2 m or 5°. CPU time is "
        "what the map took on all cores. The map alone is among the references."
    )
    header = [*rows[0].labels, "seeds"]
    for name in ERRORS:
        header += [f"network alone, {NAMES[name]}", f"network and map, {NAMES[name]}", "from", "to"]
    table = [[*header, "worst (m)", "answered by the map", "of these wrong", "CPU ms an image", "map (MiB)"]]
    for row in rows:
        if row.both is None:
            continue
        line = [*row.labels.values(), " ".join(row.seeds)]
        for name in ERRORS:
            both = row.both[name]
            line += [f"{value:.3f}" for value in (row.errors[name].mean, both.mean, both.low, both.high)]
        metrics = [trial["network_and_map"]["metrics"] for trial in row.trials]
        line.append(f"{max(each['position_error_worst_m'] for each in metrics):.2f}")
        line += [f"{mean(each[name] for each in metrics):.1%}" for name in ("accepted", "accepted_and_wrong")]
        line.append(f"{mean(each['query_cpu_ms'] for each in metrics):.0f}")
        table.append([*line, f"{row.trials[0]['map']['mib']:.2f}"])
    return [Section("network_and_map", "Network and map", text, table)] if len(table) > 1 else []


def _compared(name: str, axis: str, before: str, after: str, found: Sequence[Difference]) -> Section:
    title = f"{axis}: {after} against {before}"
    if not found:
        return Section(name, title, "Never run both.")
    text = (
        "Differences of medians on the same frames, negative where it helps. Seconds a step: after to before. Steps to "
        "the same error: to the worse of a pair's two last errors, below 1 where it is reached sooner. Both are "
        "geometric means, with the range of the pairs."
    )
    titles = [NAMES[error].replace("median", "difference of") for error in ERRORS]
    table = [[*found[0].labels, *titles, "seconds a step", "steps to the same error"]]
    for each in found:
        ratios = [_ratio(each.step_ratio), _ratio(each.reach_ratio)]
        table.append([*each.labels.values(), *(_signed(each.errors[error]) for error in ERRORS), *ratios])
    return Section(name, title, text, table)


def _times(rows: Sequence[Row], reach_m: float | None) -> Section:
    sought = "retrieval's position error" if reach_m is None else f"{reach_m:g} m"
    text = (
        "Seconds of training alone, without set-up, validation, checkpoints and export. They compare only where "
        f"device, loader and stopping rule are the same. Last column: until a validation first had {sought}."
    )
    header = [*rows[0].labels, "training (s)", "steps", "ms a step", f"seconds to {sought}"]
    table = [header]
    for row in rows:
        step_ms = [1000 * s / steps for s, steps in zip(row.train_s, row.steps, strict=True)]
        counts = [_spread(row.train_s, 1), f"{mean(row.steps):.0f}", _spread(step_ms, 0)]
        table.append([*row.labels.values(), *counts, _reached(row, reach_m)])
    return Section("training_time", "Training time", text, table)


def _reached(row: Row, reach_m: float | None) -> str:
    retrieval = row.references.get("retrieval")
    if reach_m is None and retrieval is not None:
        reach_m = retrieval["position_error_m"]
    if reach_m is None or not all(map(history, row.trials)):
        return ""
    reached_s = [seconds for seconds in row.reached_s(reach_m) if seconds is not None]
    if not reached_s:
        return "never"
    return _spread(reached_s, 1) + (
        "" if len(reached_s) == len(row.trials) else f" ({len(reached_s)} of {len(row.trials)} seeds)"
    )


def _references(rows: Sequence[Row]) -> Section:
    """What needs no training, once for the same answer to the same frames."""
    text = "What any localizer must beat; the nearest training pose is what no retrieval could."
    found = dict.fromkeys(
        (row.data, str(row.train_frames), name.replace("_", " "), *(f"{medians[error]:.3f}" for error in ERRORS))
        for row in rows
        for name, medians in row.references.items()
    )
    header = ["data", "trained on", "answer", *(NAMES[error] for error in ERRORS)]
    return Section("references", "References", text, [header, *map(list, found)] if found else None)


def _failures(failed: Sequence[StoredTrial]) -> Section:
    header = [*failed[0].labels, "error"]
    return Section("failed", "Failed", "", [header, *([*trial.labels.values(), str(trial.error)] for trial in failed)])


def _signed(figure: Estimate) -> str:
    sure = "" if figure.is_sure else ", may be 0"
    return f"{figure.mean:+.3f} ({figure.low:+.3f} to {figure.high:+.3f}{sure})"


def _ratio(values: Sequence[float]) -> str:
    if not values:
        return ""
    return f"{geometric_mean(values):.2f}" + (f" ({min(values):.2f} to {max(values):.2f})" if len(values) > 1 else "")


def _spread(values: Sequence[float], digits: int) -> str:
    return f"{mean(values):.{digits}f}" + (f" ± {stdev(values):.{digits}f}" if len(values) > 1 else "")
