"""What happens around training."""

from mambaloc.callbacks.atomic_checkpoints import AtomicCheckpointIO
from mambaloc.callbacks.early_stopping import EarlyStopping
from mambaloc.callbacks.map_build import MapBuild
from mambaloc.callbacks.moved_run import MovedRun
from mambaloc.callbacks.onnx_export import OnnxExport
from mambaloc.callbacks.progress import PoseProgressBar
from mambaloc.callbacks.time_budget import TimeBudget
from mambaloc.callbacks.trajectory_plot import TrajectoryPlot
from mambaloc.callbacks.view_refresh import ViewRefresh
from mambaloc.callbacks.view_sheet import ViewSheet
from mambaloc.callbacks.wall_clock import WallClock
from mambaloc.renamed import renamed

__all__ = [
    "AtomicCheckpointIO",
    "EarlyStopping",
    "MapBuild",
    "MovedRun",
    "OnnxExport",
    "PoseProgressBar",
    "TimeBudget",
    "TrajectoryPlot",
    "ViewRefresh",
    "ViewSheet",
    "WallClock",
]

__getattr__ = renamed(__name__, {"WholeCheckpoints": "AtomicCheckpointIO"})
