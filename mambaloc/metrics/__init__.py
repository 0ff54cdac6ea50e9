"""Pose errors over a whole split."""

from typing import TYPE_CHECKING, Any

from mambaloc.lazy import lazy
from mambaloc.renamed import renamed

if TYPE_CHECKING:
    from mambaloc.metrics.pose_errors import PoseErrors, PoseErrorTable, error_table, summarize
    from mambaloc.metrics.summary import RECALL_THRESHOLDS, summarize_errors

# Imported on first use: a sparse map is measured without torch.
_EXPORTS = {
    "PoseErrorTable": "mambaloc.metrics.pose_errors",
    "PoseErrors": "mambaloc.metrics.pose_errors",
    "RECALL_THRESHOLDS": "mambaloc.metrics.summary",
    "error_table": "mambaloc.metrics.pose_errors",
    "summarize": "mambaloc.metrics.pose_errors",
    "summarize_errors": "mambaloc.metrics.summary",
}

__all__ = ["RECALL_THRESHOLDS", "PoseErrorTable", "PoseErrors", "error_table", "summarize", "summarize_errors"]

_exported = lazy(__name__, _EXPORTS)
_renamed = renamed(__name__, {"summarise": "summarize", "summarise_errors": "summarize_errors"})


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    return _exported(name) if name in _EXPORTS else _renamed(name)
