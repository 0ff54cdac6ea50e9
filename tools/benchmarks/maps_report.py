"""What :mod:`maps_robustness` measured: a table in Markdown, JSON, and a figure over several scenes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from maps_robustness import FAR_DEG, FAR_M, Answers, compare, save_answers, wilson_interval
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from mambaloc import provenance
from mambaloc.errors import InputError
from mambaloc.evaluation.intervals import block_resamples
from mambaloc.files import atomic_file, read_json, writing
from mambaloc.viz.curves import COLORS, finish
from mambaloc.viz.trajectory import write_png

RESULT_FILE = "robustness.json"

_WAYS = {"network": (COLORS[2], "s"), "map": (COLORS[1], "o"), "both": ("#111827", "|")}
"""Colours that every kind of colour vision distinguishes, and a mark of its own for each."""

_COLUMNS = (
    "", "by", "median", "mean", "worst", f"above {FAR_M} m", f"above {FAR_DEG:.0f}°", "accepted",
    "of these wrong (95 %)", "ms", "both, against the better one",
)  # fmt: skip
_METRICS = {"position_error_m": "m median", "rotation_error_deg": "° median", "wrong": "% wrong"}


def summarize(
    found: Mapping[str, Mapping[str, Answers]], sequences: Sequence[str], about: Mapping[str, Any]
) -> dict[str, Any]:
    """Figures of each disturbance and way, how both compare with each alone, and where they come from.

    Args:
        found: of :func:`maps_robustness.measure`.
        sequences: of each frame; blocks that are drawn again do not cross them.
        about: what was measured: scene, map, network.
    """
    resamples = block_resamples(sequences)
    disturbances = {
        name: {
            "ways": {way: answers.summary() for way, answers in ways.items()},
            "both_less": {
                way: compare(ways["both"], ways[way], resamples) for way in ("network", "map") if "both" in ways
            },
        }
        for name, ways in found.items()
    }
    accepted = [ways["both" if "both" in ways else "map"] for ways in found.values()]
    trials = sum(each.is_accepted.sum() / len(each.is_accepted) for each in accepted)
    wrong = sum((each.is_accepted & each.is_wrong).sum() / len(each.is_accepted) for each in accepted)
    return {
        **about,
        "disturbances": disturbances,
        "accepted_and_wrong": [float(wrong / max(trials, 1e-9)), *wilson_interval(wrong, trials)],
        "accepted": float(trials),
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "machine": provenance.machine(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def write_result(result: Mapping[str, Any], found: Mapping[str, Mapping[str, Answers]], folder: Path) -> None:
    """Write ``robustness.json``, ``robustness.md``, and every frame's errors as ``answers.npz``.

    Raises:
        InputError: where the folder cannot be written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in (
            (RESULT_FILE, json.dumps(_finite(result), indent=2) + "\n"),
            ("robustness.md", table(result)),
        ):
            with atomic_file(folder / name) as partial:
                partial.write_text(text, encoding="utf-8")
        save_answers(found, folder / "answers.npz")


def table(result: Mapping[str, Any]) -> str:
    """The figures as a table in Markdown, a row a disturbance and way."""
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|---" * len(_COLUMNS) + "|"]
    for name, measured in result["disturbances"].items():
        for way, of in measured["ways"].items():
            compared = _verdict(measured["both_less"]) if way == "both" else ""
            lines.append("| " + " | ".join((name, way, *_cells(of, way, result["unit"]), compared)) + " |")
            name = ""
    share, low, high = result["accepted_and_wrong"]
    pooled = f"{_percent(share)} ({100 * low:.2f} to {100 * high:.2f})"
    return "\n".join((*lines, "", f"Accepted and wrong over all rows: {pooled} of {result['accepted']:.0f} poses.", ""))


def _cells(of: Mapping[str, Any], way: str, unit: str) -> tuple[str, ...]:
    low, high = of["accepted_and_wrong_interval"]
    has_rule = way != "network" and of["accepted"]
    wrong = f"{_percent(of['accepted_and_wrong'])} ({100 * low:.1f} to {100 * high:.1f})" if has_rule else ""
    return (
        _pose(of["position_error_m"], of["rotation_error_deg"], unit),
        _pose(of["position_error_mean_m"], of["rotation_error_mean_deg"], unit),
        _pose(of["position_error_worst_m"], of["rotation_error_worst_deg"], unit),
        _percent(of["above_20cm"]),
        _percent(of["above_5deg"]),
        "" if way == "network" else _percent(of["accepted"]),
        wrong,
        f"{of['query_cpu_ms']:.0f}",
    )


def _pose(off_m: float | None, off_deg: float | None, unit: str) -> str:
    """JSON has null where there was no pose."""
    if off_m is None or off_deg is None or not np.isfinite(off_m):
        return "no pose"
    return f"{off_m:.3f} {unit}, {off_deg:.2f}°"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _verdict(both_less: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    """Where both are worse than one alone beyond noise: the whole interval of the difference is above 0."""
    worse = []
    for way, metrics in both_less.items():
        for metric, (difference, low, high) in metrics.items():
            if low is not None and low > 0:  # null is minus infinity: with a network, both always answer
                scale = 100 if metric == "wrong" else 1
                numbers = " to ".join(f"{scale * each:.3g}" for each in (low, high))
                worse.append(f"worse than {way}: {scale * difference:+.3g} ({numbers}) {_METRICS[metric]}")
    return "; ".join(worse) or "not worse"


def overview(results: Sequence[Mapping[str, Any]]) -> str:
    """Errors on undisturbed images, and what each way costs: a table in Markdown, a row a scene and way."""
    far = f"over {FAR_M} m or {FAR_DEG:.0f}° off"
    lines = [f"| | | median | mean | {far} | a query | size | preparation |", "|---" * 8 + "|"]
    for result in results:
        name = result["label"]
        for way, of in result["disturbances"]["undisturbed"]["ways"].items():
            parts = [result[part] for part in ("network", "map") if way in (part, "both") and result[part]]
            taken_s = [part["preparation_cpu_s"] for part in parts]
            cells = (
                _pose(of["position_error_m"], of["rotation_error_deg"], result["unit"]),
                _pose(of["position_error_mean_m"], of["rotation_error_mean_deg"], result["unit"]),
                _percent(of["wrong"]),
                f"{of['query_cpu_ms']:.0f} ms",
                f"{sum(part['bytes'] for part in parts) / 2**20:.2f} MiB",
                "" if None in taken_s else f"{sum(taken_s):.3g} core-s",
            )
            lines.append("| " + " | ".join((name, way, *cells)) + " |")
            name = ""
    return "\n".join((*lines, ""))


def by_disturbance(result: Mapping[str, Any]) -> str:
    """Median errors and the share of wrong poses of one scene: a table in Markdown, a row a disturbance."""
    ways = list(result["disturbances"]["undisturbed"]["ways"])
    last = ways[-1]
    lines = [f"| {result['label']} | {' | '.join(ways)} | accepted | of these wrong (95 %) | both |"]
    lines.append("|---" * (4 + len(ways)) + "|")
    for name, measured in result["disturbances"].items():
        cells = [
            f"{_pose(of['position_error_m'], of['rotation_error_deg'], result['unit'])}; {100 * of['wrong']:.0f} %"
            for of in measured["ways"].values()
        ]
        compared = _verdict(measured["both_less"]) if last == "both" else ""
        lines.append(
            "| "
            + " | ".join((name, *cells, *_cells(measured["ways"][last], last, result["unit"])[5:7], compared))
            + " |"
        )
    return "\n".join((*lines, ""))


def read_results(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Read what :func:`write_result` wrote into folders.

    Raises:
        InputError: where a file cannot be read or holds something else.
    """
    found = []
    for folder in folders:
        result = read_json(folder / RESULT_FILE, "measure it with maps.py robustness", "measure it again")
        if not isinstance(result, dict) or "disturbances" not in result:
            raise InputError(f"{folder / RESULT_FILE}: does not hold a measurement. Measure it again.")
        found.append(result)
    return found


def draw(results: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw medians above and tails below, a column a scene, a line a disturbance.

    Raises:
        InputError: where the image cannot be written.
    """
    figure = Figure(figsize=(2.2 + 2.5 * len(results), 6.8), layout="constrained")
    grid = figure.subplots(2, len(results), squeeze=False, sharey=True)
    for (above, below), result in zip(grid.T, results, strict=True):
        _draw_medians(above, result)
        _draw_tails(below, result)
        above.set_title(result["label"].replace(", ", "\n"), fontsize=10)
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=3, frameon=False, fontsize=11)
    with writing(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(figure, path)


def _draw_medians(axes: Axes, result: Mapping[str, Any]) -> None:
    values = _values(result, "position_error_m")
    finite = [each for of in values.values() for each in of if np.isfinite(each)]
    low, lost = min(finite) / 1.5, max(finite) * 1.8
    axes.set(xscale="log", xlim=(low, lost * 1.5), xlabel=f"median position error [{result['unit']}]")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if lost < 200 * low else (1,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    _draw_marks(axes, {way: [min(each, lost) for each in of] for way, of in values.items()}, result)
    for row, each in enumerate(values["map"]):
        if not np.isfinite(each):
            axes.annotate("no pose", (lost, row), (6, -7), textcoords="offset points", fontsize=9, ha="right",
                          va="top", color=_WAYS["map"][0])  # fmt: skip


def _draw_tails(axes: Axes, result: Mapping[str, Any]) -> None:
    axes.set(xlim=(-4, 104), xlabel=f"over {FAR_M} {result['unit']} or {FAR_DEG:.0f}° off [% of frames]")
    _draw_marks(axes, {way: [100 * each for each in of] for way, of in _values(result, "wrong").items()}, result)


def _draw_marks(axes: Axes, values: Mapping[str, Sequence[float]], result: Mapping[str, Any]) -> None:
    rows = np.arange(len(result["disturbances"]))
    for way, of in values.items():
        color, mark = _WAYS[way]
        size, width = (14, 2.6) if way == "both" else (7, 1)
        axes.plot(of, rows, linestyle="", color=color, marker=mark, ms=size, mew=width, label=way)
    axes.set_yticks(rows, list(result["disturbances"]))
    axes.set_ylim(len(rows) - 0.5, -0.5)
    finish(axes)


def _values(result: Mapping[str, Any], metric: str) -> dict[str, list[float]]:
    measured = list(result["disturbances"].values())
    ways = [way for way in _WAYS if way in measured[0]["ways"]]
    return {way: [_number(each["ways"][way][metric]) for each in measured] for way in ways}


def _number(value: float | None) -> float:
    return np.inf if value is None else value


def _finite(value: Any) -> Any:
    """The same with null for infinity, which JSON has not."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
