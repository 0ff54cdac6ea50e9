import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mambaloc.data.frames import Frames
from mambaloc.evaluation.references import median_training_pose
from mambaloc.metrics import PoseErrors
from mambaloc.types import PoseBatch, PosePrediction


def frames(position_m, rotation):
    n = len(position_m)
    return Frames(("x",) * n, ("seq-01",) * n, position_m, rotation.as_quat(canonical=True, scalar_first=True))


def test_median_training_pose_answers_the_middle_of_the_training_frames():
    rng = np.random.default_rng(0)
    rotations = Rotation.from_euler("xyz", rng.normal(0, 0.4, (51, 3)))
    train = frames(rng.normal(0, 2, (51, 3)), rotations)
    true_m, true_q = rng.normal(0, 2, (6, 3)), Rotation.from_euler("xyz", rng.normal(0, 1, (6, 3)))
    errors = PoseErrors()
    quaternion = torch.from_numpy(true_q.as_quat(scalar_first=True)).float()
    batch = PoseBatch(torch.zeros(6, 3, 2, 2), torch.from_numpy(true_m).float(), quaternion, torch.arange(6))
    errors.update(PosePrediction(torch.zeros(6, 3), quaternion), batch)

    reference = median_training_pose(train, errors.table())
    expected_m = np.median(np.linalg.norm(true_m - np.median(train.position_m, axis=0), axis=1))
    expected_deg = np.median(np.degrees((rotations.mean().inv() * true_q).magnitude()))
    assert reference["position_error_m"] == pytest.approx(expected_m, rel=1e-5)
    assert reference["rotation_error_deg"] == pytest.approx(expected_deg, rel=1e-4)
