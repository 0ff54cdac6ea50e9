"""Pose errors over a whole split."""

from mambaloc.metrics.pose_errors import (
    RECALL_THRESHOLDS,
    PoseErrors,
    PoseErrorTable,
    error_table,
    summarise,
    summarise_errors,
)

__all__ = ["RECALL_THRESHOLDS", "PoseErrorTable", "PoseErrors", "error_table", "summarise", "summarise_errors"]
