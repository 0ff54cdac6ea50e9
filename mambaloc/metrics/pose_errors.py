"""The metric every system is measured by: per-frame errors of a whole split, and their summary."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from mambaloc.geometry import canonical, position_error_m, rotation_error_deg
from mambaloc.metrics.summary import summarize_errors
from mambaloc.types import PoseBatch, PosePrediction


@dataclass(frozen=True)
class PoseErrorTable:
    """Predictions and errors of a split, one row a frame, in the order of the split.

    Shape:
        ``index``, ``position_error_m`` and ``rotation_error_deg`` (N,); positions (N, 3) in metres; quaternions
        (N, 4), canonical. Where no pose was found, it is NaN and its errors are infinite.
    """

    index: Tensor
    predicted_position_m: Tensor
    predicted_quaternion: Tensor
    true_position_m: Tensor
    true_quaternion: Tensor
    position_error_m: Tensor
    rotation_error_deg: Tensor

    @classmethod
    def of(
        cls,
        index: Tensor,
        predicted_position_m: Tensor,
        predicted_quaternion: Tensor,
        true_position_m: Tensor,
        true_quaternion: Tensor,
    ) -> Self:
        """Compute the errors of predictions; quaternions may have any sign."""
        predicted_quaternion, true_quaternion = canonical(predicted_quaternion), canonical(true_quaternion)
        return cls(
            index,
            predicted_position_m,
            predicted_quaternion,
            true_position_m,
            true_quaternion,
            position_error_m(predicted_position_m, true_position_m),
            rotation_error_deg(predicted_quaternion, true_quaternion),
        )


class PoseErrors(Metric):
    """Collect every frame's prediction; correct under DDP, where a median of medians would not be.

    Frames that a distributed sampler repeats are counted once. A frame that is taken for another scene's has no pose in
    this one's frame: NaN, and infinite errors.
    """

    full_state_update = False
    index: list[Tensor]
    predicted_position_m: list[Tensor]
    predicted_quaternion: list[Tensor]
    true_position_m: list[Tensor]
    true_quaternion: list[Tensor]
    is_recognized: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        for state in (
            "index",
            "predicted_position_m",
            "predicted_quaternion",
            "true_position_m",
            "true_quaternion",
            "is_recognized",
        ):
            self.add_state(state, default=[], dist_reduce_fx="cat")

    def update(self, prediction: PosePrediction, target: PoseBatch) -> None:
        """Add a batch."""
        self.index.append(target.index)
        self.predicted_position_m.append(prediction.position_m.detach().float())
        self.predicted_quaternion.append(prediction.quaternion.detach().float())
        self.true_position_m.append(target.position_m)
        self.true_quaternion.append(target.quaternion)
        is_recognized = torch.ones_like(target.index, dtype=torch.bool)
        if prediction.scene_logits is not None and target.scene is not None:
            is_recognized = prediction.scene_logits.argmax(dim=-1) == target.scene
        self.is_recognized.append(is_recognized)

    def compute(self) -> dict[str, float]:
        """Reduce the whole split; see :func:`summarize`."""
        return summarize(self._table())

    def table(self) -> PoseErrorTable:
        """Return every frame's prediction and errors; every process must call it."""
        with self.sync_context():
            return self._table()

    def _table(self) -> PoseErrorTable:
        index = dim_zero_cat(self.index)
        order = index.unique(return_inverse=True)[1]
        first = torch.full((int(order.max()) + 1,), len(index), device=index.device)
        first = first.scatter_reduce(0, order, torch.arange(len(index), device=index.device), "amin")
        poses = (self.predicted_position_m, self.predicted_quaternion, self.true_position_m, self.true_quaternion)
        predicted_m, predicted, true_m, true = (dim_zero_cat(state)[first] for state in poses)
        is_recognized = dim_zero_cat(self.is_recognized)[first]
        predicted_m, predicted = (torch.where(is_recognized[:, None], p, torch.nan) for p in (predicted_m, predicted))
        table = PoseErrorTable.of(index[first], predicted_m, predicted, true_m, true)
        position_m, rotation_deg = (
            torch.where(is_recognized, errors, torch.inf)
            for errors in (table.position_error_m, table.rotation_error_deg)
        )
        return replace(table, position_error_m=position_m, rotation_error_deg=rotation_deg)


def error_table(
    localize: Callable[[Tensor, Tensor | None], PosePrediction], batches: Iterable[PoseBatch]
) -> PoseErrorTable:
    """Localize frames, and return every frame's prediction and errors.

    Only this process's frames count: one process of a distributed training may call it alone.

    Args:
        localize: images, (B, 3, H, W) in 0..1, and their intrinsics, (B, 3, 3) in pixels, to poses.
        batches: of a split, cropped.
    """
    errors = PoseErrors()
    for batch in batches:
        errors.update(localize(batch.image, batch.intrinsics), batch)
    return errors._table()  # table() would wait for the other processes


def summarize(table: PoseErrorTable) -> dict[str, float]:
    """Reduce per-frame errors; see :func:`summarize_errors`."""
    return summarize_errors(table.position_error_m.cpu().numpy(), table.rotation_error_deg.cpu().numpy())
