"""Which frames a map is built from, how, and how it is measured: a small YAML file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mambaloc.errors import InputError
from mambaloc.files import read_yaml
from mambaloc.mapping.building import POINTS, MapSettings


@dataclass(frozen=True)
class MapRecipe:
    """A scene and the settings of its map.

    Args:
        scene: name of a dataset's scene, or the path of an imported one.
        dataset: as :class:`~mambaloc.data.PoseDataModule` takes it.
        root: as :class:`~mambaloc.data.PoseDataModule` takes it.
        label: name of the map in results; the scene's name unless given.
        settings: how the map is built.
        ransac_seeds: each test frame is localized once with each.
    """

    scene: str
    dataset: str = "7scenes"
    root: str | None = None
    label: str | None = None
    settings: MapSettings = field(default_factory=MapSettings)
    ransac_seeds: tuple[int, ...] = (0, 1, 2)

    @property
    def name(self) -> str:
        """Name of the map in results."""
        return self.label or Path(self.scene).name


_TYPES = {"scene": str, "dataset": str, "root": str, "label": str}
MINIMUM = {"key_frames": 2, "width": 32, "most_bytes": 1000, "least_inliers": 4, "seed": 0}
"""Smallest allowed value of each setting."""


def read_recipe(path: Path) -> MapRecipe:
    """Read a recipe.

    Raises:
        InputError: for a file that cannot be read, a key that is unknown, or a value of another kind.
    """
    data = read_yaml(path, "give a recipe, or an imported scene's folder", "correct it")
    if not isinstance(data, dict) or not isinstance(data.get("scene"), str):
        raise InputError(f"{path}: does not name a scene. Add 'scene: NAME'.")
    for key, value in data.items():
        if key in _TYPES:
            fits, what = isinstance(value, str), "text"
        elif key in MINIMUM:
            fits, what = _is_int(value, MINIMUM[key]), f"a whole number of {MINIMUM[key]} or more"
        elif key == "points":
            fits, what = value in POINTS, " or ".join(POINTS)
        elif key == "ransac_seeds":
            fits = isinstance(value, list) and len(value) > 0 and all(_is_int(seed, 0) for seed in value)
            what = "a list of whole numbers"
        else:
            known = ", ".join((*_TYPES, *MINIMUM, "points", "ransac_seeds"))
            raise InputError(f"{path}: {key!r} is unknown. Choose among {known}.")
        if not fits:
            raise InputError(f"{path}: {key} is {str(value)[:40]!r}. Give {what}.")
    settings = MapSettings(**{key: value for key, value in data.items() if key in (*MINIMUM, "points")})
    texts = {key: value for key, value in data.items() if key in _TYPES}
    return MapRecipe(**texts, settings=settings, ransac_seeds=tuple(data.get("ransac_seeds", (0, 1, 2))))


def recipe_of(source: Path) -> MapRecipe:
    """The recipe in a file, or the default one of an imported scene's folder; errors are :func:`read_recipe`'s."""
    if not source.is_dir():
        return read_recipe(source)
    folder = source if source.name not in ("", "..") else source.resolve()
    # A recipe's plain name is one of the dataset's scenes; this is a folder.
    return MapRecipe(f"./{folder}" if str(folder) == folder.name else str(folder))


def _is_int(value: object, minimum: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= minimum
