"""A sweep of trainings as a file: every combination of its axes is a trial, which is one ``train.py`` command."""

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
from mambaloc.recipes import recipe_path

_KEYS = ("axes", "common_args", "exclude", "time_limit_s", "cpus", "gpus")
_RENAMED = {"always": "common_args", "without": "exclude"}
_OTHER_RUN = re.compile(r"\{(\w+)=([^{}]+)\}")  # in an argument: the run of the trial that differs so


@dataclass(frozen=True)
class Trial:
    """One training and its evaluation.

    Args:
        labels: its place on each axis.
        args: arguments of ``train.py``: recipe, overlays, options; ``{axis=label}`` stands for another trial's run.
        key: digest of the arguments and of the files among them.
        after: keys of the trials whose runs it needs.
    """

    labels: Mapping[str, str]
    args: tuple[str, ...]
    key: str
    after: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Its labels in a line."""
        return " ".join(self.labels.values())

    def command(self, run_folder: Callable[[str], Path]) -> tuple[str, ...]:
        """The arguments, with each ``{axis=label}`` replaced by that trial's folder: ``run_folder`` of its key."""
        others = iter(self.after)
        return tuple(_OTHER_RUN.sub(lambda _: str(run_folder(next(others))), arg) for arg in self.args)


@dataclass(frozen=True)
class Sweep:
    """All trials of a file, those that others need first.

    Args:
        trials: every combination that is not excluded.
        time_limit_s: of one trial; one that takes longer is stopped, and has failed.
        cpus: that one trial takes.
        gpus: GPUs of a trial; a fraction shares one.
    """

    trials: tuple[Trial, ...]
    time_limit_s: float
    cpus: float
    gpus: float


def read_sweep(path: Path) -> Sweep:
    """Read a sweep::

        axes:                       # every combination of a label an axis is a trial
          system:                   # the first axis names the recipe
            posenet: [recipes/posenet_7scenes.yaml]
            geometric: [recipes/posenet_geometric_7scenes.yaml, --model.warm_start,
                        "{system=posenet}/checkpoints/last.ckpt"]
          gis: {none: [recipes/overlays/gis_none.yaml], gis: [recipes/overlays/gis.yaml]}
          seed: {0: [--seed_everything, 0], 1: [--seed_everything, 1]}
        common_args: [recipes/overlays/redkitchen_blocks.yaml]   # of every trial, after the recipe
        exclude: [{system: geometric, gis: none}]                # combinations that are left out
        time_limit_s: 3600
        cpus: 1
        gpus: 0

    Raises:
        InputError: where the file is not a sweep, or names what does not exist.
    """
    content = read_yaml(path, "give a sweep of trainings", "repair it")
    if not isinstance(content, dict) or not isinstance(content.get("axes"), dict) or not content["axes"]:
        raise InputError(f"{path}: has no 'axes'. Add axes with labels and their arguments.")
    for old, new in _RENAMED.items():
        if old in content:
            raise InputError(f"{path}: '{old}' is now called '{new}'. Rename the key.")
    if unknown := sorted(set(map(str, content)) - set(_KEYS)):
        raise InputError(f"{path}: unknown key {', '.join(unknown)}; choose among {', '.join(_KEYS)}")
    axes = {str(axis): _labels(path, str(axis), labels) for axis, labels in content["axes"].items()}
    numbers = {name: _number(path, name, content.get(name, default)) for name, default in _NUMBERS.items()}
    excluded = [_combination(path, axes, entry) for entry in content.get("exclude") or []]
    trials = tuple(_trials(path, axes, _args(path, "common_args", content.get("common_args") or []), excluded))
    if not trials:
        raise InputError(f"{path}: excludes every trial; exclude fewer")
    return Sweep(trials, **numbers)


_NUMBERS = {"time_limit_s": 86400.0, "cpus": 1.0, "gpus": 0.0}


def _trials(
    path: Path,
    axes: dict[str, dict[str, tuple[str, ...]]],
    common: tuple[str, ...],
    excluded: list[dict[str, str]],
) -> Iterator[Trial]:
    """Make the trials, each after those whose runs it needs."""
    waiting: dict[tuple[str, ...], tuple[str, ...]] = {}
    for labels in itertools.product(*axes.values()):
        place = dict(zip(axes, labels, strict=True))
        if not any(entry.items() <= place.items() for entry in excluded):
            first, *others = (axes[axis][label] for axis, label in place.items())
            ordered = (*first, *common, *itertools.chain(*others))
            waiting[labels] = tuple(sorted(ordered, key=lambda arg: not arg.endswith(_FILES)))  # options come last
    made: dict[tuple[str, ...], Trial] = {}
    while waiting:
        before = len(made)
        for labels, args in list(waiting.items()):
            place = dict(zip(axes, labels, strict=True))
            needs = [_place_of(path, place, match) for arg in args for match in _OTHER_RUN.finditer(arg)]
            if lacking := next((need for need in needs if need not in made and need not in waiting), None):
                raise InputError(
                    f"{path}: {' '.join(labels)} needs the run of {' '.join(lacking)}, which is excluded; do "
                    "not exclude it"
                )
            if all(need in made for need in needs):
                after = tuple(made[need].key for need in needs)
                made[labels] = Trial(place, args, _digest(path, args, after), after)
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


def _digest(path: Path, args: tuple[str, ...], after: tuple[str, ...]) -> str:
    digest = hashlib.sha256(json.dumps([args, after]).encode())
    for arg in args:
        if arg.endswith(_FILES):
            try:
                digest.update(recipe_path(arg).read_bytes())
            except OSError as error:
                raise InputError(f"{path}: {arg} cannot be read ({error.strerror}); name a recipe or overlay") from None
            except InputError as error:
                raise InputError(f"{path}: {error}") from None
    return digest.hexdigest()


def _labels(path: Path, axis: str, labels: Any) -> dict[str, tuple[str, ...]]:
    if not isinstance(labels, dict) or not labels:
        raise InputError(f"{path}: axis {axis} has no labels; give each its arguments, as 'none: [overlay.yaml]'")
    return {str(label): _args(path, f"axis {axis}, {label}", args) for label, args in labels.items()}


def _args(path: Path, where: str, args: Any) -> tuple[str, ...]:
    if not isinstance(args, list) or any(isinstance(arg, dict | list) for arg in args):
        raise InputError(f"{path}: {where}: is {args!r}; give a list of recipes, overlays and options")
    return tuple(json.dumps(arg) if isinstance(arg, bool) or arg is None else str(arg) for arg in args)


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
        raise InputError(f"{path}: exclude: {entry or 'an entry'} names no place on the axes; give axes and labels")
    return entry
