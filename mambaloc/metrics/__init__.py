"""Pose errors over a whole split."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mambaloc.metrics.pose_errors import PoseErrors, PoseErrorTable, error_table, summarise
    from mambaloc.metrics.summary import RECALL_THRESHOLDS, summarise_errors

# Imported on first use: a sparse map is measured without torch.
_EXPORTS = {
    "PoseErrorTable": "mambaloc.metrics.pose_errors",
    "PoseErrors": "mambaloc.metrics.pose_errors",
    "RECALL_THRESHOLDS": "mambaloc.metrics.summary",
    "error_table": "mambaloc.metrics.pose_errors",
    "summarise": "mambaloc.metrics.pose_errors",
    "summarise_errors": "mambaloc.metrics.summary",
}

__all__ = ["RECALL_THRESHOLDS", "PoseErrorTable", "PoseErrors", "error_table", "summarise", "summarise_errors"]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module 'mambaloc.metrics' has no attribute {name!r}")
