"""Find a system by name."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from fnmatch import fnmatch
from typing import Any, TypeVar

from mambaloc.errors import InputError, suggestion
from mambaloc.models.base import LitPoseRegressor
from mambaloc.plugins import MODELS, load_plugin, plugin_names

_MODELS: dict[str, type[LitPoseRegressor]] = {}
_System = TypeVar("_System", bound=type[LitPoseRegressor])


def register_model(name: str) -> Callable[[_System], _System]:
    """Class decorator that makes a system known by ``name``.

    A class of the same qualified name, as when a notebook's cell is run twice, replaces the first with a warning.

    Raises:
        ValueError: if another class has the name.
    """

    def register(cls: _System) -> _System:
        known = _MODELS.get(name)
        if known and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ValueError(f"model {name!r} is registered already, by {_MODELS[name].__qualname__}")
        if known and known is not cls:
            warnings.warn(f"model {name!r} is registered again. The new {cls.__qualname__} replaces it.", stacklevel=2)
        cls.registry_name = name
        _MODELS[name] = cls
        return cls

    return register


def list_models(pattern: str = "*") -> list[str]:
    """Names of the systems that match a wildcard, those of other installed packages among them, sorted."""
    return sorted(name for name in {*_MODELS, *plugin_names(MODELS)} if fnmatch(name, pattern))


def model_class(name: str) -> type[LitPoseRegressor]:
    """Return the class registered as ``name``, here or by an entry point of an installed package.

    Raises:
        InputError: for an unknown name, with near misses, and for an entry point that cannot be loaded.
    """
    if name not in _MODELS:
        load_plugin(MODELS, name)  # whose register_model does the rest
    if name not in _MODELS:
        if "." in name:
            raise InputError(
                f"unknown model {name!r}. Names with a dot are of released models: "
                f"use mambaloc.create_model({name!r}, pretrained=True)."
            )
        raise InputError(f"unknown model {name!r}. {suggestion(name, list_models())}")
    return _MODELS[name]


def create_model(name: str, **kwargs: Any) -> LitPoseRegressor:
    """Build an untrained system; its plain ``nn.Module`` is ``.network``.

    Raises:
        InputError: for an unknown name.
    """
    return model_class(name)(**kwargs)
