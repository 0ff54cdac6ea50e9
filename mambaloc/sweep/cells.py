"""A matrix of trainings as a file: axes whose every combination is a cell, each one ``train.py`` command."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mambaloc.errors import InputError
from mambaloc.files import read_yaml

_KEYS = ("axes", "always", "without", "time_limit_s", "cpus", "gpus")
_OTHER_RUN = re.compile(r"\{(\w+)=([^{}]+)\}")  # in a word: the run of the cell that differs so


@dataclass(frozen=True)
class Cell:
    """One training and its evaluation.

    Args:
        labels: its place on each axis.
        words: of ``train.py``: recipe, overlays, options; ``{axis=label}`` stands for another cell's run.
        key: digest of the words and of what the files among them say.
        after: keys of the cells whose runs it needs.
    """

    labels: Mapping[str, str]
    words: tuple[str, ...]
    key: str
    after: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Its labels in a line."""
        return " ".join(self.labels.values())

    def command(self, run_folder: Callable[[str], Path]) -> tuple[str, ...]:
        """The words, with other cells' runs, which ``run_folder`` finds by key, in place of what stands for them."""
        others = iter(self.after)
        return tuple(_OTHER_RUN.sub(lambda _: str(run_folder(next(others))), word) for word in self.words)


@dataclass(frozen=True)
class Matrix:
    """All cells of a file, those that others need first.

    Args:
        cells: every combination that is not left out.
        time_limit_s: of one cell; one that takes longer is stopped, and has failed.
        cpus: that one cell takes.
        gpus: likewise; a fraction shares one.
    """

    cells: tuple[Cell, ...]
    time_limit_s: float
    cpus: float
    gpus: float


def read_matrix(path: Path) -> Matrix:
    """Read a matrix::

        axes:                       # every combination of a label an axis is a cell
          system:                   # the first axis names the recipe
            posenet: [recipes/posenet_7scenes.yaml]
            geometric: [recipes/posenet_geometric_7scenes.yaml, --model.warm_start,
                        "{system=posenet}/checkpoints/last.ckpt"]
          gis: {none: [recipes/overlays/gis_none.yaml], gis: [recipes/overlays/gis.yaml]}
          seed: {0: [--seed_everything, 0], 1: [--seed_everything, 1]}
        always: [recipes/overlays/redkitchen_blocks.yaml]   # in every cell, after the recipe
        without: [{system: geometric, gis: none}]           # combinations that are left out
        time_limit_s: 3600
        cpus: 1
        gpus: 0

    Raises:
        InputError: where the file is none, or names what is not there.
    """
    told = read_yaml(path, "give a matrix of trainings", "mend it")
    if not isinstance(told, dict) or not isinstance(told.get("axes"), dict) or not told["axes"]:
        raise InputError(f"{path}: names no axes; a matrix has 'axes', each with labels and their words")
    if unknown := sorted(set(map(str, told)) - set(_KEYS)):
        raise InputError(f"{path}: has {', '.join(unknown)}; a matrix has {', '.join(_KEYS)}")
    axes = {str(axis): _labels(path, str(axis), labels) for axis, labels in told["axes"].items()}
    numbers = {name: _number(path, name, told.get(name, default)) for name, default in _NUMBERS.items()}
    left_out = [_combination(path, axes, entry) for entry in told.get("without") or []]
    cells = tuple(_cells(path, axes, _words(path, "always", told.get("always") or []), left_out))
    if not cells:
        raise InputError(f"{path}: leaves out every cell; leave fewer out")
    return Matrix(cells, **numbers)


_NUMBERS = {"time_limit_s": 86400.0, "cpus": 1.0, "gpus": 0.0}


def _cells(
    path: Path, axes: dict[str, dict[str, tuple[str, ...]]], always: tuple[str, ...], left_out: list[dict[str, str]]
) -> Iterator[Cell]:
    """Make the cells, each after those whose runs it needs."""
    waiting: dict[tuple[str, ...], tuple[str, ...]] = {}
    for labels in itertools.product(*axes.values()):
        place = dict(zip(axes, labels, strict=True))
        if not any(entry.items() <= place.items() for entry in left_out):
            first, *others = (axes[axis][label] for axis, label in place.items())
            said = (*first, *always, *itertools.chain(*others))
            waiting[labels] = tuple(sorted(said, key=lambda word: not word.endswith(_FILES)))  # options come last
    made: dict[tuple[str, ...], Cell] = {}
    while waiting:
        before = len(made)
        for labels, words in list(waiting.items()):
            place = dict(zip(axes, labels, strict=True))
            needs = [_place_of(path, place, match) for word in words for match in _OTHER_RUN.finditer(word)]
            if lacking := next((need for need in needs if need not in made and need not in waiting), None):
                raise InputError(f"{path}: {' '.join(labels)} needs the run of {' '.join(lacking)}, which is left out")
            if all(need in made for need in needs):
                after = tuple(made[need].key for need in needs)
                made[labels] = Cell(place, words, _digest(path, words, after), after)
                del waiting[labels]
                yield made[labels]
        if len(made) == before:
            raise InputError(
                f"{path}: {' '.join(next(iter(waiting)))} needs a run that needs its own; break the circle"
            )


_FILES = (".yaml", ".yml")


def _place_of(path: Path, place: dict[str, str], other: re.Match[str]) -> tuple[str, ...]:
    axis, label = other.groups()
    if axis not in place:
        raise InputError(f"{path}: {other[0]} names the axis {axis}; there are {', '.join(place)}")
    return tuple({**place, axis: label}.values())


def _digest(path: Path, words: tuple[str, ...], after: tuple[str, ...]) -> str:
    digest = hashlib.sha256(json.dumps([words, after]).encode())
    for word in words:
        if word.endswith(_FILES):
            try:
                digest.update(Path(word).read_bytes())
            except OSError as error:
                raise InputError(
                    f"{path}: {word} cannot be read ({error.strerror}); name a recipe or overlay"
                ) from None
    return digest.hexdigest()


def _labels(path: Path, axis: str, labels: Any) -> dict[str, tuple[str, ...]]:
    if not isinstance(labels, dict) or not labels:
        raise InputError(f"{path}: axis {axis} has no labels; give each its words, as 'none: [overlay.yaml]'")
    return {str(label): _words(path, f"axis {axis}, {label}", words) for label, words in labels.items()}


def _words(path: Path, where: str, words: Any) -> tuple[str, ...]:
    if not isinstance(words, list) or any(isinstance(word, dict | list) for word in words):
        raise InputError(f"{path}: {where}: is {words!r}; give a list of recipes, overlays and options")
    return tuple(json.dumps(word) if isinstance(word, bool) or word is None else str(word) for word in words)


def _number(path: Path, name: str, value: Any) -> float:
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not (value > 0 or (name == "gpus" and value == 0))
    ):
        raise InputError(f"{path}: {name} is {value!r}; give a number above 0")
    return float(value)


def _combination(path: Path, axes: dict[str, dict[str, tuple[str, ...]]], entry: Any) -> dict[str, str]:
    entry = {str(axis): str(label) for axis, label in entry.items()} if isinstance(entry, dict) else {}
    if not entry or any(label not in axes.get(axis, {}) for axis, label in entry.items()):
        raise InputError(f"{path}: without: {entry or 'an entry'} names no place on the axes; give axes and labels")
    return entry
