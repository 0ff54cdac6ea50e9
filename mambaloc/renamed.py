"""Old names of what was renamed: they stay importable for one release, with a warning."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any


def renamed(module: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """Make a module's ``__getattr__`` that finds attributes under their old names.

    Args:
        module: its ``__name__``.
        names: the old name of each attribute, and the new one.

    Raises:
        AttributeError: for any other name, as a module without ``__getattr__`` does.
    """

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        message = f"{module}.{name} is now {names[name]}. The old name is removed in the next release."
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(sys.modules[module], names[name])

    return find
