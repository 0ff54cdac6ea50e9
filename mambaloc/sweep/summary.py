"""What a sweep's results come to: a row a place on the axes over its seeds, and differences on the same frames."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.evaluation.intervals import LEVEL, block_resamples
from mambaloc.sweep.store import StoredTrial

SEED = "seed"
"""The axis that rows are means over."""

ALL = "all"
"""The label, on the first axis, of a difference over all of its labels."""

ERRORS = {"position_error_m": "m", "rotation_error_deg": "°"}


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds of medians over frames, or a difference of two such, with its 95 % interval.

    Args:
        mean: over the seeds.
        low: end of the interval, by bootstrap over blocks of frames, all seeds resampled alike.
        high: end of the interval.
    """

    mean: float
    low: float
    high: float

    @property
    def is_sure(self) -> bool:
        """Of a difference: whether its sign is that of the whole interval."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class Row:
    """One place on the axes.

    Args:
        labels: the place, its seed left out.
        seeds: labels of the seeds that were run.
        errors: a figure for each of ``ERRORS``.
        train_s: seconds of training alone, a seed each.
        steps: of training, a seed each.
        train_frames: that it was trained on.
        test_frames: that its errors are over.
        data: dataset and scene, and whether they are the benchmark's own split.
        selection: how the epoch was chosen.
        references: medians of answers that need no training, by name; a map's among them, which has no seeds.
        both: a figure for each of ``ERRORS`` of the network and the map together; None where a seed was run without.
        trials: the results themselves, a seed each.
    """

    labels: dict[str, str]
    seeds: tuple[str, ...]
    errors: dict[str, Estimate]
    train_s: tuple[float, ...]
    steps: tuple[int, ...]
    train_frames: int
    test_frames: int
    data: str
    selection: str
    references: dict[str, dict[str, float]]
    both: dict[str, Estimate] | None
    trials: tuple[dict[str, Any], ...]

    @property
    def beats_retrieval(self) -> bool | None:
        """Of the position's median; None where retrieval was not measured."""
        retrieval = self.references.get("retrieval")
        return None if retrieval is None else self.errors["position_error_m"].mean < retrieval["position_error_m"]

    def reached_s(self, error_m: float) -> tuple[float | None, ...]:
        """Training seconds to a median position error, a seed each; None where it never got there."""
        return tuple(reached_s(trial, error_m) for trial in self.trials)


@dataclass(frozen=True)
class Difference:
    """What one label of an axis changes against another, all else equal, on the same frames.

    Args:
        labels: the place, without the axis and the seed; ``ALL`` on the first axis for the mean over it.
        errors: a figure for each of ``ERRORS``: negative where the change helps.
        step_ratio: training seconds a step after the change to those before it, a pair each.
        reach_ratio: steps to the worse of the two last errors, as a ratio; empty where no curve was kept.
    """

    labels: dict[str, str]
    errors: dict[str, Estimate]
    step_ratio: tuple[float, ...]
    reach_ratio: tuple[float, ...]


def rows_of(trials: Iterable[StoredTrial], epoch: str = "last") -> list[Row]:
    """Put the trials of each place together; those that failed, or do not have the epoch, are left out.

    Args:
        trials: of a store.
        epoch: ``last`` or ``best``.
    """
    return [_row(labels, group, epoch) for labels, group in _places(trials, epoch, (SEED,))]


def differences(
    trials: Iterable[StoredTrial], axis: str, before: str, after: str, epoch: str = "last"
) -> list[Difference]:
    """Compare two labels of an axis wherever both were run, seed by seed; then over all of the first axis.

    Args:
        trials: of a store.
        axis: that differs.
        before: its label that is compared with.
        after: the other.
        epoch: ``last`` or ``best``.

    Raises:
        InputError: where the axis has no such label, or results do not hold errors of the same frames.
    """
    trials = list(trials)
    for label in (before, after):
        if not any(trial.labels.get(axis) == label for trial in trials):
            raise InputError(f"--compare {axis}: no trial that ended has {label} there")
    found = []
    together: dict[tuple[tuple[str, str], ...], list[Pair]] = {}
    for labels, group in _places(trials, epoch, (SEED, axis)):
        if pairs := _pairs(group, axis, before, after, epoch):
            found.append(_difference(labels, pairs))
            (first, _), *others = labels.items()
            together.setdefault(((first, ALL), *others), []).extend(pairs)
    counts = [sum({**dict(place), first: ""} == {**each.labels, first: ""} for each in found) for place in together]
    return found + [
        _difference(dict(place), pairs)
        for count, (place, pairs) in zip(counts, together.items(), strict=True)
        if count > 1
    ]


def reached_s(result: dict[str, Any], error_m: float) -> float | None:
    """Training seconds after which a validation's median position error was first so low; None if it never was."""
    return next((each["train_s"] for each in history(result) if each["position_error_m"] <= error_m), None)


def history(result: dict[str, Any]) -> list[dict[str, float]]:
    """Step, training seconds and median errors of each validation; none where none was kept."""
    return result["training"]["wall_clock"].get("history", [])


def data_label(result: dict[str, Any]) -> str:
    """Say which frames an error is over: the benchmark's own, rendered ones, or others."""
    data, counts = result["data"], frame_counts(result)
    if data["official_split"]:
        return f"{data['dataset']}/{data['scene']}, official split"
    kind = "rendered, not the benchmark" if data.get("rendered") else "no official split"
    return f"{data['dataset']}/{data['scene']}, {kind} ({counts[0]} training and {counts[1]} test frames)"


def frame_counts(result: dict[str, Any]) -> tuple[int, int]:
    """Frames that the training and the test split list, before any is left out."""
    return result["training"]["data"]["listed_frames"]["train"], result["data"]["listed_frames"]["test"]


Pair = tuple[dict[str, Any], dict[str, Any]]


def _pairs(group: list[StoredTrial], axis: str, before: str, after: str, epoch: str) -> list[Pair]:
    by_seed: dict[str, dict[str, dict[str, Any]]] = {}
    for trial in group:
        by_seed.setdefault(trial.labels.get(SEED, ""), {})[trial.labels.get(axis, "")] = trial.results[epoch]
    pairs = [(of[before], of[after]) for of in by_seed.values() if before in of and after in of]
    for pair in pairs:
        first, second = (_frames(result)["image"] for result in pair)
        if first != second:
            raise InputError(
                f"--compare {axis}: {before} and {after} were measured on different frames. Run them again."
            )
    return pairs


def _places(
    trials: Iterable[StoredTrial], epoch: str, without: Sequence[str]
) -> list[tuple[dict[str, str], list[StoredTrial]]]:
    places: dict[tuple[tuple[str, str], ...], list[StoredTrial]] = {}
    for trial in trials:
        if trial.error is None and epoch in trial.results:
            place = tuple((axis, label) for axis, label in trial.labels.items() if axis not in without)
            places.setdefault(place, []).append(trial)
    order: dict[str, list[str]] = {}  # of labels as they come: trials that end side by side end in any order
    for axis, label in itertools.chain.from_iterable(places):
        order.setdefault(axis, []).append(label)
    ranks = sorted(places, key=lambda place: [order[axis].index(label) for axis, label in place])
    return [(dict(place), places[place]) for place in ranks]


def _row(labels: dict[str, str], group: list[StoredTrial], epoch: str) -> Row:
    group = sorted(group, key=lambda trial: trial.labels.get(SEED, ""))
    results = [trial.results[epoch] for trial in group]
    first, rows = results[0], _resamples(results[0])
    both = [result.get("network_and_map") for result in results]
    return Row(
        labels=labels,
        seeds=tuple(trial.labels.get(SEED, "") for trial in group),
        errors=_figures(results, rows),
        train_s=tuple(result["training"]["wall_clock"]["train_s"] for result in results),
        steps=tuple(result["training"]["step"] for result in results),
        train_frames=first["training"]["data"]["train_frames"],
        test_frames=first["count"],
        data=data_label(first),
        selection=first["selection"],
        references={**first["references"], **_map_alone(first)},
        both=_figures([each for each in both if each], rows) if all(both) else None,
        trials=tuple(results),
    )


def _figures(results: list[dict[str, Any]], rows: NDArray[np.int64]) -> dict[str, Estimate]:
    return {name: _figure([_medians(result, name, rows) for result in results]) for name in ERRORS}


def _map_alone(result: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Its medians, which JSON has as null where it found no pose in most frames."""
    if "map" not in result:
        return {}
    of, medians = result["map"], {name: result["map"]["metrics"][name] for name in ERRORS}
    name = f"map of {of['key_frames']} key frames, {of['width']} px"
    return {name: {error: math.inf if each is None else each for error, each in medians.items()}}


def _frames(result: dict[str, Any]) -> dict[str, list[Any]]:
    """Images and errors of single frames."""
    frames: dict[str, list[Any]] = result.get("frames", {})
    if not frames.get("image"):
        raise InputError(
            f"{result['data']['scene']}: a result has no errors of single frames, which a report needs. "
            "Run the sweep into an empty folder."
        )
    return frames


def _resamples(result: dict[str, Any]) -> NDArray[np.int64]:
    return block_resamples([image.rpartition("/")[0] for image in _frames(result)["image"]])


def _medians(result: dict[str, Any], name: str, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """The median over all frames, then those of each resample."""
    errors = np.array(_frames(result)[name])
    return np.array([np.median(errors), *np.median(errors[rows], axis=1)])


def _difference(labels: dict[str, str], pairs: list[Pair]) -> Difference:
    errors = {}
    resampled = [_resamples(before) for before, _ in pairs]  # alike for the same frames, apart for other scenes
    for name in ERRORS:
        medians = [
            [_medians(result, name, rows) for result in pair] for pair, rows in zip(pairs, resampled, strict=True)
        ]
        errors[name] = _figure([after - before for before, after in medians])
    reach = tuple(ratio for pair in pairs if (ratio := _reach_ratio(pair)) is not None)
    return Difference(labels, errors, tuple(_step_s(after) / _step_s(before) for before, after in pairs), reach)


def _figure(medians: list[NDArray[np.float64]]) -> Estimate:
    mean = np.mean(medians, axis=0)
    low, high = np.quantile(mean[1:], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(float(mean[0]), float(low), float(high))


def _step_s(result: dict[str, Any]) -> float:
    return result["training"]["wall_clock"]["train_s"] / result["training"]["step"]


def _reach_ratio(pair: Pair) -> float | None:
    """Steps to an error that both got to, the worse of their last ones: after, to before."""
    curves = [history(result) for result in pair]
    if not all(curves):
        return None
    shared_m = max(curve[-1]["position_error_m"] for curve in curves)
    before, after = (next(e["step"] for e in curve if e["position_error_m"] <= shared_m) for curve in curves)
    return after / before
