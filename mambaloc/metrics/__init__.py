"""Pose errors over a whole split."""

from mambaloc.metrics.pose_errors import (
    RECALL_THRESHOLDS,
    PoseErrors,
    PoseErrorTable,
    error_table,
    summarize,
    summarize_errors,
)
from mambaloc.renamed import renamed

__all__ = ["RECALL_THRESHOLDS", "PoseErrorTable", "PoseErrors", "error_table", "summarize", "summarize_errors"]

__getattr__ = renamed(__name__, {"summarise": "summarize", "summarise_errors": "summarize_errors"})
