"""What a matrix's results come to: a row a place on the axes over its seeds, and differences on the same frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.evaluation.intervals import LEVEL, block_resamples
from mambaloc.matrix.store import StoredCell

SEED = "seed"
"""The axis that rows are means over."""

ERRORS = {"position_error_m": "m", "rotation_error_deg": "°"}


@dataclass(frozen=True)
class Figure:
    """A mean over seeds of medians over frames, or a difference of two such, with its 95 % interval.

    Args:
        mean: over the seeds.
        low: end of the interval, by bootstrap over blocks of frames, all seeds resampled alike.
        high: likewise.
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
        train_s: mean seconds of training alone.
        train_frames: that it was trained on.
        test_frames: that its errors are over.
        data: dataset and scene, and whether they are the benchmark's own split.
        selection: how the epoch was chosen.
        beats_retrieval: of the position's median; None where retrieval was not measured.
    """

    labels: dict[str, str]
    seeds: tuple[str, ...]
    errors: dict[str, Figure]
    train_s: float
    train_frames: int
    test_frames: int
    data: str
    selection: str
    beats_retrieval: bool | None


@dataclass(frozen=True)
class Difference:
    """What one label of an axis changes against another, all else equal, on the same frames.

    Args:
        labels: the place, without the axis and the seed.
        errors: a figure for each of ``ERRORS``: negative where the change helps.
    """

    labels: dict[str, str]
    errors: dict[str, Figure]


def rows_of(cells: Iterable[StoredCell], epoch: str = "last") -> list[Row]:
    """Put the cells of each place together; those that failed, or lack the epoch, are left out.

    Args:
        cells: of a store.
        epoch: ``last`` or ``best``.
    """
    return [_row(labels, group, epoch) for labels, group in _places(cells, epoch, (SEED,))]


def differences(
    cells: Iterable[StoredCell], axis: str, before: str, after: str, epoch: str = "last"
) -> list[Difference]:
    """Compare two labels of an axis wherever both were run, seed by seed.

    Args:
        cells: of a store.
        axis: that differs.
        before: its label that is compared with.
        after: the other.
        epoch: ``last`` or ``best``.

    Raises:
        InputError: where the axis has no such label.
    """
    found = []
    cells = list(cells)
    for label in (before, after):
        if not any(cell.labels.get(axis) == label for cell in cells):
            raise InputError(f"--compare {axis}: no cell that ended has {label} there")
    for labels, group in _places(cells, epoch, (SEED, axis)):
        by_seed: dict[str, dict[str, StoredCell]] = {}
        for cell in group:
            by_seed.setdefault(cell.labels.get(SEED, ""), {})[cell.labels[axis]] = cell
        pairs = [(of[before], of[after]) for of in by_seed.values() if before in of and after in of]
        if pairs:
            rows = _resamples(pairs[0][0], epoch)
            errors = {name: _difference(pairs, name, epoch, rows) for name in ERRORS}
            found.append(Difference(labels, errors))
    return found


def _places(
    cells: Iterable[StoredCell], epoch: str, without: Sequence[str]
) -> list[tuple[dict[str, str], list[StoredCell]]]:
    places: dict[tuple[tuple[str, str], ...], list[StoredCell]] = {}
    for cell in cells:
        if cell.error is None and epoch in cell.results:
            place = tuple((axis, label) for axis, label in cell.labels.items() if axis not in without)
            places.setdefault(place, []).append(cell)
    return [(dict(place), group) for place, group in places.items()]


def _row(labels: dict[str, str], group: list[StoredCell], epoch: str) -> Row:
    results = [cell.results[epoch] for cell in group]
    first, rows = results[0], _resamples(group[0], epoch)
    errors = {name: _figure([_medians(result, name, rows) for result in results]) for name in ERRORS}
    data, retrieval = first["data"], first["references"].get("retrieval")
    split = "official split" if data["official_split"] else "no official split"
    return Row(
        labels=labels,
        seeds=tuple(sorted(cell.labels.get(SEED, "") for cell in group)),
        errors=errors,
        train_s=float(np.mean([result["training"]["wall_clock"]["train_s"] for result in results])),
        train_frames=first["training"]["data"]["train_frames"],
        test_frames=first["count"],
        data=f"{data['dataset']}/{data['scene']}, {split}",
        selection=first["selection"],
        beats_retrieval=None if retrieval is None else errors["position_error_m"].mean < retrieval["position_error_m"],
    )


def _resamples(cell: StoredCell, epoch: str) -> NDArray[np.int64]:
    images = cell.results[epoch]["frames"]["image"]
    return block_resamples([image.rpartition("/")[0] for image in images])


def _medians(result: dict[str, Any], name: str, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """The median over all frames, then those of each resample."""
    errors = np.array(result["frames"][name])
    return np.array([np.median(errors), *np.median(errors[rows], axis=1)])


def _difference(pairs: list[tuple[StoredCell, StoredCell]], name: str, epoch: str, rows: NDArray[np.int64]) -> Figure:
    told = [[_medians(cell.results[epoch], name, rows) for cell in pair] for pair in pairs]
    return _figure([after - before for before, after in told])


def _figure(medians: list[NDArray[np.float64]]) -> Figure:
    mean = np.mean(medians, axis=0)
    low, high = np.quantile(mean[1:], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Figure(float(mean[0]), float(low), float(high))
