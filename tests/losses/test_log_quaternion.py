import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from mambaloc.errors import InputError
from mambaloc.geometry import quaternion_from_log
from mambaloc.losses import LogQuaternionWeights, RelativeLogQuaternionWeights
from mambaloc.types import PoseBatch, PosePrediction


def about_z(*degrees: float) -> torch.Tensor:
    """Quaternions wxyz of turns about z; their logarithms are (0, 0, half the angle)."""
    xyzw = Rotation.from_rotvec([[0, 0, math.radians(angle)] for angle in degrees]).as_quat()
    return torch.from_numpy(xyzw[:, [3, 0, 1, 2]]).float()


def batch(position_m: list[list[float]], quaternion: torch.Tensor, clip_length: int = 1) -> PoseBatch:
    count = len(position_m)
    return PoseBatch(
        torch.zeros(count, 3, 2, 2), torch.tensor(position_m), quaternion, torch.arange(count), clip_length
    )


def prediction(position_m: list[list[float]], log_quaternion: list[list[float]]) -> PosePrediction:
    log = torch.tensor(log_quaternion)
    return PosePrediction(torch.tensor(position_m), quaternion_from_log(log), log_quaternion=log)


# Three frames of a clip: true x is 0, 1, 3 m and the true turns 0, 20, 60 degrees, so half angles of 0, 10, 30 degrees.
TRUE_M = [[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]
TRUE_Q = about_z(0, 20, 60)
SAID = prediction(
    [[0.5, 0, 0], [1, 0, -0.25], [2, 0, 0]],
    [[0.0, 0, 0], [0, 0, math.radians(10)], [0, 0.1, math.radians(30)]],
)
ABSOLUTE_M = (0.5 + 0.25 + 1) / 3
ABSOLUTE_LOG = 0.1 / 3
# MapNet's equation 3, from one frame to the next: true (1, 0, 0) and (2, 0, 0), said (0.5, 0, -0.25) and (1, 0, 0.25).
RELATIVE_M = ((0.5 + 0.25) + (1 + 0.25)) / 2
RELATIVE_LOG = 0.1 / 2


def test_absolute_distances_by_hand():
    loss = LogQuaternionWeights(s_position=0.5, s_rotation=-3.0)
    expected = ABSOLUTE_M * math.exp(-0.5) + 0.5 + ABSOLUTE_LOG * math.exp(3.0) - 3.0
    assert loss(SAID, batch(TRUE_M, TRUE_Q)).item() == pytest.approx(expected, rel=1e-5)


def test_relative_poses_by_hand():
    loss = RelativeLogQuaternionWeights(0.0, 0.0, s_relative_position=1.0, s_relative_rotation=-2.0)
    expected = ABSOLUTE_M + ABSOLUTE_LOG + RELATIVE_M * math.exp(-1.0) + 1.0 + RELATIVE_LOG * math.exp(2.0) - 2.0
    assert loss(SAID, batch(TRUE_M, TRUE_Q, clip_length=3)).item() == pytest.approx(expected, rel=1e-5)


def test_clips_are_apart():
    """The last frame of a clip and the first of the next make no pair."""
    loss = RelativeLogQuaternionWeights(0.0, 0.0, 0.0, 0.0)
    said = prediction([[1.0, 0, 0], [1, 0, 0], [5, 0, 0], [5, 0, 0]], [[0.0, 0, 0]] * 4)
    still = batch([[0.0, 0, 0]] * 4, about_z(0, 0, 0, 0), clip_length=2)
    assert loss(said, still).item() == pytest.approx((1 + 1 + 5 + 5) / 4)


def test_both_signs_of_a_true_quaternion_are_one_rotation():
    loss = LogQuaternionWeights()
    assert_close(loss(SAID, batch(TRUE_M, TRUE_Q)), loss(SAID, batch(TRUE_M, -TRUE_Q)))


def test_half_turns_and_none_have_finite_gradients():
    log = torch.zeros(3, 3, requires_grad=True)
    said = PosePrediction(torch.zeros(3, 3), quaternion_from_log(log), log_quaternion=log)
    LogQuaternionWeights()(said, batch([[0.0, 0, 0]] * 3, about_z(0, 180, 179.999))).backward()
    assert log.grad.isfinite().all()


def test_single_frames_are_refused_in_training_and_have_no_relative_pose_in_evaluation():
    loss, single = RelativeLogQuaternionWeights(), batch(TRUE_M, TRUE_Q)
    with pytest.raises(InputError, match=r"needs clips.*data.clip_length.*data.clip_skip"):
        loss(SAID, single)
    assert_close(loss.eval()(SAID, single), LogQuaternionWeights()(SAID, single))


def test_a_system_of_quaternions_is_told():
    with pytest.raises(InputError, match=r"regresses log-quaternions.*learned_weights"):
        LogQuaternionWeights()(PosePrediction(torch.zeros(3, 3), TRUE_Q), batch(TRUE_M, TRUE_Q))


def test_no_weight_is_decayed():
    loss = RelativeLogQuaternionWeights()
    assert loss.no_weight_decay() == {name for name, _ in loss.named_parameters()}
    assert len(loss.no_weight_decay()) == 4
