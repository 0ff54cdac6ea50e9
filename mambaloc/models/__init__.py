"""The systems, a file each. Every module here is imported, so a new system is one new file."""

from importlib import import_module
from pkgutil import iter_modules

from mambaloc.models.base import LitPoseRegressor
from mambaloc.models.checkpoint import Checkpoint
from mambaloc.models.registry import create_model, list_models, register_model

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = ["Checkpoint", "LitPoseRegressor", "create_model", "list_models", "register_model"]
