"""Recipes by name: those of a checkout's ``recipes/``, which an installation has, too."""

from __future__ import annotations

from pathlib import Path

from mambaloc.errors import InputError, suggestion
from mambaloc.files import shipped_folder

_FOLDER = shipped_folder("recipes")


def list_recipes() -> list[str]:
    """Names of the recipes that come with the package, such as ``quickstart`` and ``overlays/gis``, sorted."""
    return sorted(
        path.relative_to(_FOLDER).with_suffix("").as_posix()
        for pattern in ("*.yaml", "overlays/*.yaml")
        for path in _FOLDER.glob(pattern)
    )


def recipe_path(recipe: str) -> Path:
    """Find a recipe.

    Args:
        recipe: path of a YAML file; or the name of one that comes with the package, such as ``quickstart`` or
            ``recipes/quickstart.yaml``.

    Raises:
        InputError: if there is no such recipe.
    """
    path = Path(recipe)
    if path.is_file():
        return path
    name = path.with_suffix("").as_posix().removeprefix("recipes/")
    if name in list_recipes():
        return _FOLDER / f"{name}.yaml"
    raise InputError(f"{recipe}: no such recipe. {suggestion(name, list_recipes())}")
