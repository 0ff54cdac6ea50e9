import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mambaloc.data.frames import Frames
from mambaloc.evaluation.references import median_training_pose, nearest_training_pose, retrieval
from mambaloc.metrics import PoseErrors
from mambaloc.types import PoseBatch, PosePrediction


def frames(position_m, rotation):
    n = len(position_m)
    return Frames(("x",) * n, ("seq-01",) * n, position_m, rotation.as_quat(canonical=True, scalar_first=True))


def table_of(true_m, true_q):
    errors, count = PoseErrors(), len(true_m)
    quaternion = torch.from_numpy(true_q.as_quat(scalar_first=True)).float()
    batch = PoseBatch(torch.zeros(count, 3, 2, 2), torch.from_numpy(true_m).float(), quaternion, torch.arange(count))
    errors.update(PosePrediction(torch.zeros(count, 3), quaternion), batch)
    return errors.table()


def scene():
    rng = np.random.default_rng(0)
    rotations = Rotation.from_euler("xyz", rng.normal(0, 0.4, (51, 3)))
    train = frames(rng.normal(0, 2, (51, 3)), rotations)
    true_m, true_q = rng.normal(0, 2, (6, 3)), Rotation.from_euler("xyz", rng.normal(0, 1, (6, 3)))
    return train, rotations, true_m, true_q


def test_nearest_training_pose_against_a_tree_search():
    train, rotations, true_m, true_q = scene()
    distance_m, nearest = cKDTree(train.position_m).query(true_m)
    found = nearest_training_pose(train, table_of(true_m, true_q))
    assert found["position_error_m"] == pytest.approx(np.median(distance_m), rel=1e-5)
    angles = np.degrees((rotations[nearest].inv() * true_q).magnitude())
    assert found["rotation_error_deg"] == pytest.approx(np.median(angles), rel=1e-4)


def test_retrieval_answers_what_looks_alike():
    train, rotations, true_m, true_q = scene()
    rng = np.random.default_rng(1)
    features = rng.normal(size=(51, 8))
    alike = np.array([3, 50, 7, 7, 20, 11])
    test_features = torch.from_numpy(5 * features[alike] + rng.normal(0, 1e-3, (6, 8)))  # how bright does not matter
    found = retrieval(train, torch.from_numpy(features), test_features, table_of(true_m, true_q))
    expected_m = np.median(np.linalg.norm(true_m - train.position_m[alike], axis=1))
    expected_deg = np.median(np.degrees((rotations[alike].inv() * true_q).magnitude()))
    assert found["retrieval"]["position_error_m"] == pytest.approx(expected_m, rel=1e-5)
    assert found["retrieval"]["rotation_error_deg"] == pytest.approx(expected_deg, rel=1e-4)

    cosine = (test_features.numpy() @ features.T) / np.linalg.norm(features, axis=1)
    five = np.argsort(-cosine, axis=1)[:, :5]
    means_m = np.median(
        [np.linalg.norm(m - train.position_m[rows].mean(0)) for m, rows in zip(true_m, five, strict=True)]
    )
    angles = [(rotations[rows].mean().inv() * q).magnitude() for q, rows in zip(true_q, five, strict=True)]
    assert found["retrieval_mean_of_5"]["position_error_m"] == pytest.approx(means_m, rel=1e-5)
    assert found["retrieval_mean_of_5"]["rotation_error_deg"] == pytest.approx(np.degrees(np.median(angles)), rel=1e-3)


def test_median_training_pose_answers_the_middle_of_the_training_frames():
    train, rotations, true_m, true_q = scene()
    reference = median_training_pose(train, table_of(true_m, true_q))
    expected_m = np.median(np.linalg.norm(true_m - np.median(train.position_m, axis=0), axis=1))
    expected_deg = np.median(np.degrees((rotations.mean().inv() * true_q).magnitude()))
    assert reference["position_error_m"] == pytest.approx(expected_m, rel=1e-5)
    assert reference["rotation_error_deg"] == pytest.approx(expected_deg, rel=1e-4)
