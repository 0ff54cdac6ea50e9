"""Find a system by name."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from fnmatch import fnmatch
from typing import Any, TypeVar

from mambaloc.errors import InputError
from mambaloc.models.base import LitPoseRegressor

_MODELS: dict[str, type[LitPoseRegressor]] = {}
_System = TypeVar("_System", bound=type[LitPoseRegressor])


def register_model(name: str) -> Callable[[_System], _System]:
    """Class decorator that makes a system known by ``name``.

    The same class again, as of a notebook's cell that is run twice, replaces the first.

    Raises:
        ValueError: where another class has the name.
    """

    def register(cls: _System) -> _System:
        known = _MODELS.get(name)
        if known and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ValueError(f"model {name!r} is registered already, by {_MODELS[name].__qualname__}")
        cls.registry_name = name
        _MODELS[name] = cls
        return cls

    return register


def list_models(pattern: str = "*") -> list[str]:
    """Names of the registered systems that match a wildcard, sorted."""
    return sorted(name for name in _MODELS if fnmatch(name, pattern))


def model_class(name: str) -> type[LitPoseRegressor]:
    """Return the class registered as ``name``.

    Raises:
        InputError: for an unknown name, with near misses.
    """
    if name not in _MODELS:
        near = difflib.get_close_matches(name, _MODELS, n=3, cutoff=0.4) or list_models()
        raise InputError(f"model {name!r}: there is none; did you mean {', '.join(near)}?")
    return _MODELS[name]


def create_model(name: str, **kwargs: Any) -> LitPoseRegressor:
    """Build an untrained system; its plain ``nn.Module`` is ``.network``.

    Raises:
        InputError: for an unknown name.
    """
    return model_class(name)(**kwargs)
