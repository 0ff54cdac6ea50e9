"""What other installed packages add: systems and datasets, named by entry points."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from mambaloc.errors import InputError

MODELS = "mambaloc.models"
"""Group of entry points that name LightningModules with :func:`~mambaloc.models.register_model`."""

DATASETS = "mambaloc.datasets"
"""Group of entry points that name :class:`~mambaloc.data.datasets.dataset.Dataset` objects, each by its own name."""


def plugin_names(group: str) -> set[str]:
    """Names of a group's entry points."""
    return set(entry_points(group=group).names)


def load_plugin(group: str, name: str) -> Any:
    """Import what an entry point names; None where there is no such entry point.

    Raises:
        InputError: where it cannot be imported.
    """
    for point in entry_points(group=group, name=name):
        try:
            return point.load()
        except (ImportError, AttributeError) as error:
            package = point.dist.name if point.dist else point.value
            raise InputError(f"{name!r}: package {package} cannot be loaded ({error}). Install it again.") from None
    return None
