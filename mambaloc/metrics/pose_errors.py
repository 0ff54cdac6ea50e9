"""The metric every system is measured by: per-frame errors of a whole split, and their summary."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from mambaloc.geometry import canonical, position_error_m, rotation_error_deg
from mambaloc.types import PoseBatch, PosePrediction

RECALL_THRESHOLDS: dict[str, tuple[float, float]] = {
    "recall_5cm_5deg": (0.05, 5.0),
    "recall_25cm_2deg": (0.25, 2.0),
    "recall_50cm_5deg": (0.50, 5.0),
}
"""Shares of frames within both a position error in metres and a rotation error in degrees."""


@dataclass(frozen=True)
class PoseErrorTable:
    """Predictions and errors of a split, one row a frame, in the order of the split.

    Shape:
        ``index``, ``position_error_m`` and ``rotation_error_deg`` (N,); positions (N, 3) in metres; quaternions
        (N, 4), canonical.
    """

    index: Tensor
    predicted_position_m: Tensor
    predicted_quaternion: Tensor
    true_position_m: Tensor
    true_quaternion: Tensor
    position_error_m: Tensor
    rotation_error_deg: Tensor


class PoseErrors(Metric):
    """Collect every frame's prediction; correct under DDP, where a median of medians would not be.

    Frames that a distributed sampler repeats are counted once.
    """

    full_state_update = False
    index: list[Tensor]
    predicted_position_m: list[Tensor]
    predicted_quaternion: list[Tensor]
    true_position_m: list[Tensor]
    true_quaternion: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        for state in (
            "index",
            "predicted_position_m",
            "predicted_quaternion",
            "true_position_m",
            "true_quaternion",
        ):
            self.add_state(state, default=[], dist_reduce_fx="cat")

    def update(self, prediction: PosePrediction, target: PoseBatch) -> None:
        """Add a batch."""
        self.index.append(target.index)
        self.predicted_position_m.append(prediction.position_m.detach().float())
        self.predicted_quaternion.append(prediction.quaternion.detach().float())
        self.true_position_m.append(target.position_m)
        self.true_quaternion.append(target.quaternion)

    def compute(self) -> dict[str, float]:
        """Reduce the whole split; see :func:`summarise`."""
        return summarise(self._table())

    def table(self) -> PoseErrorTable:
        """Return every frame's prediction and errors; every process must call it."""
        with self.sync_context():
            return self._table()

    def _table(self) -> PoseErrorTable:
        index = dim_zero_cat(self.index)
        order = index.unique(return_inverse=True)[1]
        first = torch.full((int(order.max()) + 1,), len(index), device=index.device)
        first = first.scatter_reduce(0, order, torch.arange(len(index), device=index.device), "amin")
        predicted_m, true_m = (dim_zero_cat(s)[first] for s in (self.predicted_position_m, self.true_position_m))
        predicted_q, true_q = (
            canonical(dim_zero_cat(s)[first]) for s in (self.predicted_quaternion, self.true_quaternion)
        )
        return PoseErrorTable(
            index=index[first],
            predicted_position_m=predicted_m,
            predicted_quaternion=predicted_q,
            true_position_m=true_m,
            true_quaternion=true_q,
            position_error_m=position_error_m(predicted_m, true_m),
            rotation_error_deg=rotation_error_deg(predicted_q, true_q),
        )


def error_table(localise: Callable[[Tensor], PosePrediction], batches: Iterable[PoseBatch]) -> PoseErrorTable:
    """Localise frames, and return every frame's prediction and errors.

    Args:
        localise: images, (B, 3, H, W) in 0..1, to poses.
        batches: of a split, cropped.
    """
    errors = PoseErrors()
    for batch in batches:
        errors.update(localise(batch.image), batch)
    return errors.table()


def summarise(table: PoseErrorTable) -> dict[str, float]:
    """Reduce per-frame errors to medians, means and recalls; the plain names are the medians.

    The median of an even number of frames is the mean of the middle two.
    """
    # On the CPU: Apple's GPUs know no double.
    position_m, rotation_deg = table.position_error_m.cpu().double(), table.rotation_error_deg.cpu().double()
    summary = {
        "position_error_m": position_m.quantile(0.5).item(),
        "rotation_error_deg": rotation_deg.quantile(0.5).item(),
        "position_error_mean_m": position_m.mean().item(),
        "rotation_error_mean_deg": rotation_deg.mean().item(),
    }
    for name, (within_m, within_deg) in RECALL_THRESHOLDS.items():
        summary[name] = ((position_m <= within_m) & (rotation_deg <= within_deg)).double().mean().item()
    return summary
