"""What any localizer must beat: answers that need no network."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from mambaloc.data import Frames, PoseDataModule
from mambaloc.geometry import position_error_m, rotation_error_deg
from mambaloc.metrics import PoseErrorTable
from mambaloc.nn import PooledBackbone

_TOP = 5
"""Retrieved frames whose poses are averaged."""


def median_training_pose(train: Frames, table: PoseErrorTable) -> dict[str, float]:
    """Medians of always answering the training frames' middle pose.

    The position is their componentwise median, the rotation the mean that minimises squared chordal distance
    (Markley et al. 2007): the eigenvector of largest eigenvalue of the sum of ``q q^T``.

    Args:
        train: the training frames.
        table: the frames to answer for; only their true poses are read.
    """
    return _medians(table, np.median(train.position_m, axis=0)[None], _mean_quaternion(train.quaternion)[None])


def nearest_training_pose(train: Frames, table: PoseErrorTable) -> dict[str, float]:
    """Medians of answering the training pose whose position is nearest to the true one: what no retrieval can beat.

    The arguments are those of :func:`median_training_pose`.
    """
    true_m = table.true_position_m.cpu().double().numpy()
    nearest = np.linalg.norm(true_m[:, None] - train.position_m, axis=-1).argmin(axis=1)
    return _medians(table, train.position_m[nearest], train.quaternion[nearest])


def retrieval(
    train: Frames, train_features: Tensor, test_features: Tensor, table: PoseErrorTable
) -> dict[str, dict[str, float]]:
    """Medians of answering the pose of the training frame that looks most alike, and the mean pose of the first five.

    Args:
        train: the training frames.
        train_features: of their images, (M, D).
        test_features: of the images to answer for, (N, D), in the order of the table.
        table: only its true poses are read.
    """
    likeness = normalize(test_features, dim=-1) @ normalize(train_features, dim=-1).T
    found = likeness.topk(min(_TOP, len(train))).indices.cpu().numpy()
    first, positions_m = found[:, 0], train.position_m[found].mean(axis=1)
    quaternions = np.stack([_mean_quaternion(train.quaternion[rows]) for rows in found])
    return {
        "retrieval": _medians(table, train.position_m[first], train.quaternion[first]),
        f"retrieval_mean_of_{found.shape[1]}": _medians(table, positions_m, quaternions),
    }


@torch.inference_mode()
def frozen_features(backbone: PooledBackbone, data: PoseDataModule) -> tuple[Tensor, Tensor]:
    """A backbone's features of the centre crops of the training and of the test frames, (M, D) and (N, D).

    Args:
        backbone: as it starts: pretrained elsewhere, never trained on the scene.
        data: set up for ``fit`` and ``test``.
    """
    backbone.eval()
    train, test = (torch.cat([backbone(batch.image) for batch in data.batches(part)]) for part in ("train", "test"))
    return train, test


def _mean_quaternion(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    _, vectors = np.linalg.eigh(quaternions.T @ quaternions)
    return vectors[:, -1]


def _medians(
    table: PoseErrorTable, position_m: NDArray[np.float64], quaternion: NDArray[np.float64]
) -> dict[str, float]:
    """Median errors of answers, (N, 3) and (N, 4), or one answer for all."""
    answers_m, answers_q = (torch.from_numpy(np.ascontiguousarray(each)).float() for each in (position_m, quaternion))
    true_m, true_q = table.true_position_m.cpu(), table.true_quaternion.cpu()
    return {
        "position_error_m": position_error_m(true_m, answers_m).double().quantile(0.5).item(),
        "rotation_error_deg": rotation_error_deg(true_q, answers_q).double().quantile(0.5).item(),
    }
