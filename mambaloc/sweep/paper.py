"""The paper's tables, its printed figures beside ours: the same rows and columns, ours only where measured."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from importlib.resources import files
from statistics import mean, stdev
from string import ascii_lowercase
from typing import Any

import yaml

from mambaloc.benchmark.sizes import size_of
from mambaloc.data.datasets.registry import DATASETS
from mambaloc.models.weights import mib
from mambaloc.sweep.store import StoredTrial
from mambaloc.sweep.summary import SEED, frame_counts

_ALL = "all"
_MEASURED = ("error", "train_min")  # what results hold; sizes need none, and `benchmark.py latency` times inference
_PLACE = ("system", "gis", "sparsity", "scene", SEED)  # axes that rows and columns speak of; others are a basis


@dataclass(frozen=True)
class Basis:
    """What figures of ours were measured on, none of which may be mixed in one row.

    Args:
        dataset: whose layout and names.
        frames: ``official split``; or what else the frames are.
        network: its backbone and images, which are not always the paper's.
        others: labels of axes that no table of the paper has, such as the stopping rule.
    """

    dataset: str
    frames: str
    network: str
    others: tuple[str, ...]


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper, with a row of ours under each of its rows for every basis.

    Args:
        name: its key in ``paper.yaml``.
        title: its caption.
        lines: the header, then a line a row.
        footnotes: what ours were measured on; where the paper contradicts itself.
        measured: whether a figure of ours is in it.
    """

    name: str
    title: str
    lines: list[list[str]]
    footnotes: list[str]
    measured: bool


def paper_tables(trials: Iterable[StoredTrial], epoch: str = "last") -> list[PaperTable]:
    """Lay out every table of the paper.

    Args:
        trials: of a store; those that failed or do not have the epoch are left out.
        epoch: ``last`` or ``best``.
    """
    by_basis: dict[Basis, list[StoredTrial]] = {}
    for trial in trials:
        if trial.error is None and epoch in trial.results:
            by_basis.setdefault(_basis_of(trial, epoch), []).append(trial)
    return [_table(name, printed, by_basis, epoch) for name, printed in printed_tables().items()]


@cache
def printed_tables() -> dict[str, dict[str, Any]]:
    """Read the tables from ``paper.yaml``."""
    return yaml.safe_load(files("mambaloc.sweep").joinpath("paper.yaml").read_text(encoding="utf-8"))


def _basis_of(trial: StoredTrial, epoch: str) -> Basis:
    result = trial.results[epoch]
    data, hyperparameters = result["data"], result["model"]["hyperparameters"]
    train, test = frame_counts(result)
    if data["official_split"]:
        frames = "official split"
    elif data.get("rendered"):
        frames = "rendered images, not the benchmark's"
    else:
        frames = f"{data['scene']} with a split of its own, {train} training and {test} test frames: not the benchmark"
    network = f"{hyperparameters.get('backbone', 'GoogLeNet')} at {data['image_size'][0]}x{data['image_size'][1]} px"
    others = tuple(f"{axis} {label}" for axis, label in trial.labels.items() if axis not in _PLACE)
    return Basis(data["dataset"], frames, network, others)


def _table(name: str, printed: dict[str, Any], by_basis: dict[Basis, list[StoredTrial]], epoch: str) -> PaperTable:
    columns = printed["columns"]
    sparsities = sorted({column.get("sparsity", "1") for column in columns} - {_ALL}, key=Fraction, reverse=True)
    lines, bases = [["Method", *(column["name"] for column in columns)]], dict[Basis, str]()
    for row in printed["rows"]:
        lines.append([f"{row['name']}, paper", *("" if figure is None else str(figure) for figure in row["printed"])])
        specs = [{"sparsity": "1", **row, **column} for column in columns]
        sizes = [_size(spec) for spec in specs]
        ours = []
        for basis, trials in by_basis.items():
            measured = [_ours(spec, trials, basis, sparsities, epoch) for spec in specs]
            if basis.dataset == printed["dataset"] and any(measured):
                letter = bases.setdefault(basis, ascii_lowercase[len(bases) % 26])
                figures = [figure or size for figure, size in zip(measured, sizes, strict=True)]
                ours.append([f"{row['name']}, ours [{letter}]", *figures])
        lines += ours or ([[f"{row['name']}, ours", *sizes]] if any(sizes) else [])
    notes = [_describe(letter, basis, by_basis[basis], epoch) for basis, letter in bases.items()]
    if any("±" in cell for line in lines for cell in line):
        notes.append("±: standard deviation over seeds.")
    if any(column.get("what") == "mib" for column in columns):
        notes.append("Sizes of ours count what the published models carry too; mambaloc benchmark sizes prints both.")
    return PaperTable(
        name, printed["title"], lines, notes + printed["footnotes"], len(lines) > 1 + len(printed["rows"])
    )


def _ours(spec: dict[str, Any], trials: Sequence[StoredTrial], basis: Basis, sparsities: list[str], epoch: str) -> str:
    """Our figure for a place of a table, as text; nothing where a scene, a sparsity or all of it was not run."""
    what = spec.get("what", "error")
    if what not in _MEASURED:
        return ""
    scenes = _scenes(spec["scene"], trials, basis, epoch)
    wanted = [(scene, s) for scene in scenes for s in (sparsities if spec["sparsity"] == _ALL else [spec["sparsity"]])]
    for system in spec["systems"]:
        results = [(trial.labels.get(SEED, ""), trial.results[epoch]) for trial in trials]
        found = {
            (result["data"]["scene"], _sparsity(result), seed): result
            for seed, result in results
            if _is(result, system, spec["gis"], spec.get("distilled", False))
        }
        seeds = [s for s in sorted({key[2] for key in found}) if all((*place, s) in found for place in wanted)]
        runs = [[found[(*place, seed)] for place in wanted] for seed in seeds]
        if runs and what == "train_min":
            return _figure([mean(r["training"]["wall_clock"]["train_s"] / 60 for r in run) for run in runs], 2)
        if runs:
            errors = ("position_error_m", "rotation_error_deg")
            return "/".join(_figure([mean(r["metrics"][name] for r in run) for run in runs], 2) for name in errors)
    return ""


def _scenes(scene: str, trials: Sequence[StoredTrial], basis: Basis, epoch: str) -> list[str]:
    """The scenes that a figure is over: an average of the benchmark's is over all of it, others over what there is."""
    if scene != _ALL:
        return [scene]
    if basis.frames == "official split":
        return list(DATASETS[basis.dataset].official_counts)
    return list(dict.fromkeys(trial.results[epoch]["data"]["scene"] for trial in trials))


def _is(result: dict[str, Any], system: str, gis: str, distilled: bool) -> bool:
    model = result["model"]
    taught = "distilled" in result["training"]
    return (model["name"], model["hyperparameters"]["gis"], taught) == (system, gis, distilled)


def _sparsity(result: dict[str, Any]) -> str:
    data = result["training"]["data"]
    return "" if data["keep_count"] else str(Fraction(1, data["keep_every"]))


def _figure(values: list[float], digits: int) -> str:
    spread = f"±{stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{mean(values):.{digits}f}{spread}"


def _size(spec: dict[str, Any]) -> str:
    if spec.get("what") != "mib":
        return ""
    return f"{mib(size_of(spec['systems'][0], spec['gis']).published):.2f}"


def _describe(letter: str, basis: Basis, trials: Sequence[StoredTrial], epoch: str) -> str:
    results = [trial.results[epoch] for trial in trials]
    seeds = ", ".join(sorted({trial.labels.get(SEED, "") for trial in trials}))
    commits = ", ".join(sorted({str(result["training"]["commit"])[:7] for result in results}))
    devices = ", ".join(sorted({result["training"]["device"] for result in results}))
    rules = ", ".join(sorted({result["selection"].split(":")[0] for result in results}))
    scenes = ", ".join(sorted({result["data"]["scene"] for result in results}))
    budget = _range({result["training"]["step"] for result in results}, "steps")
    return (
        f"[{letter}] {'; '.join((basis.frames, *basis.others))}. Scenes: {scenes}; {basis.network}; {budget}, "
        f"{rules} epoch; seeds {seeds}; {devices}; commit {commits}."
    )


def _range(numbers: set[int], unit: str) -> str:
    return f"{min(numbers)} {unit}" if len(numbers) == 1 else f"{min(numbers)} to {max(numbers)} {unit}"
