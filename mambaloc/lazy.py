"""Names of a package that are imported on first use, so that importing the package costs nothing and needs no torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any


def lazy(package: str, exports: Mapping[str, str]) -> Callable[[str], Any]:
    """Make a package's ``__getattr__`` (PEP 562).

    Args:
        package: its ``__name__``.
        exports: the module that each name comes from.

    Raises:
        AttributeError: for any other name, as a module without ``__getattr__`` does.
        ModuleNotFoundError: with a note on how to install PyTorch, if a name needs it and it is missing.
    """

    def find(name: str) -> Any:
        if name not in exports:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            return getattr(import_module(exports[name]), name)
        except ModuleNotFoundError as error:
            if find_spec("torch") is None:
                error.add_note(f"{package}.{name} needs PyTorch. Run: pip install 'mambaloc[train]'")
            raise

    return find
