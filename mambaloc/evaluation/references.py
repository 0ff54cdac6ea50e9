"""What any localiser must beat: answers that need no network."""

from __future__ import annotations

import numpy as np
import torch

from mambaloc.data import Frames
from mambaloc.geometry import position_error_m, rotation_error_deg
from mambaloc.metrics import PoseErrorTable


def median_training_pose(train: Frames, table: PoseErrorTable) -> dict[str, float]:
    """Medians of always answering the training frames' middle pose.

    The position is their componentwise median, the rotation the mean that minimises squared chordal distance
    (Markley et al. 2007): the eigenvector of largest eigenvalue of the sum of ``q q^T``.

    Args:
        train: the training frames.
        table: the frames to answer for; only their true poses are read.
    """
    position_m = torch.from_numpy(np.median(train.position_m, axis=0)).float()
    _, vectors = np.linalg.eigh(train.quaternion.T @ train.quaternion)
    quaternion = torch.from_numpy(vectors[:, -1].copy()).float()
    return {
        "position_error_m": position_error_m(table.true_position_m, position_m).double().quantile(0.5).item(),
        "rotation_error_deg": rotation_error_deg(table.true_quaternion, quaternion).double().quantile(0.5).item(),
    }
