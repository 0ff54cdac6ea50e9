"""Log-quaternions against SciPy's rotation vectors, of which they are half."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck
from torch.testing import assert_close

from mambaloc.geometry import canonical, log_from_quaternion, quaternion_from_log, rotation_error_deg

F64 = torch.float64
ANGLES = [0.0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-5, 1e-3, 0.1, 1.0]

fast = settings(max_examples=40, deadline=None, derandomize=True)
quaternions = (
    st.tuples(*[st.floats(-10, 10)] * 4)
    .map(lambda q: torch.tensor(q, dtype=F64))
    .filter(lambda q: q.abs().max().item() > 1e-3)
)
logs = st.tuples(*[st.floats(-0.9, 0.9)] * 3).map(lambda v: torch.tensor(v, dtype=F64))  # shorter than pi / 2


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def test_log_is_half_of_scipys_rotation_vector():
    rotation = Rotation.random(200, random_state=0)
    wxyz = torch.from_numpy(rotation.as_quat()).roll(1, -1)
    assert_close(log_from_quaternion(wxyz), torch.from_numpy(rotation.as_rotvec() / 2))


def test_exponential_equals_scipys():
    log = random(200, 3)  # longer than pi / 2, too
    expected = torch.from_numpy(Rotation.from_rotvec(2 * log.numpy()).as_quat(canonical=True)).roll(1, -1)
    assert_close(canonical(quaternion_from_log(log)), expected)


@fast
@given(quaternions)
def test_there_and_back(q: Tensor):
    log = log_from_quaternion(q)
    assert torch.linalg.vector_norm(log) <= math.pi / 2 + 1e-12
    assert rotation_error_deg(quaternion_from_log(log), q) < 1e-10


@fast
@given(quaternions)
def test_q_and_minus_q_have_one_log_at_any_length(q: Tensor):
    assert torch.equal(log_from_quaternion(q), log_from_quaternion(-q))
    assert_close(log_from_quaternion(3 * q), log_from_quaternion(q), rtol=0, atol=1e-12)


@fast
@given(logs)
def test_back_and_there(log: Tensor):
    q = quaternion_from_log(log)
    assert_close(torch.linalg.vector_norm(q), torch.ones((), dtype=F64))
    assert_close(log_from_quaternion(q), log, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("half_angle", ANGLES)
def test_small_angles_keep_their_digits(half_angle: float):
    axis = torch.nn.functional.normalize(random(50, 3), dim=-1)
    log = log_from_quaternion(quaternion_from_log(axis * half_angle))
    assert_close(log, axis * half_angle, rtol=1e-12, atol=0)


@pytest.mark.parametrize("below", ANGLES)
def test_near_half_a_turn(below: float):
    axis = torch.nn.functional.normalize(random(50, 3), dim=-1)
    sine, cosine = math.sin(below), math.cos(below)
    log = log_from_quaternion(torch.cat([torch.full((50, 1), sine, dtype=F64), cosine * axis], dim=-1))
    assert_close(torch.linalg.vector_norm(log, dim=-1), torch.full((50,), math.pi / 2 - below, dtype=F64))
    np.testing.assert_allclose(np.abs((log * axis).sum(-1)), math.pi / 2 - below, atol=1e-12)


@pytest.mark.parametrize("function", [log_from_quaternion, quaternion_from_log])
def test_gradients(function):
    assert gradcheck(function, random(6, 4 if function is log_from_quaternion else 3).requires_grad_())


@pytest.mark.parametrize("angle", [0.0, 1e-20, 1e-7, math.pi / 2])
def test_gradients_are_finite_at_the_borders(angle: float):
    log = torch.tensor([angle, 0, 0], dtype=F64, requires_grad=True)
    q = quaternion_from_log(log)
    q.retain_grad()
    (log_from_quaternion(q) * torch.tensor([1.0, 2, 3], dtype=F64)).sum().backward()
    assert log.grad is not None
    assert q.grad is not None
    assert log.grad.isfinite().all()
    assert q.grad.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("lead", [(), (0,), (5,), (2, 3)])
def test_dtype_and_leading_dimensions_are_kept(lead: tuple[int, ...], dtype: torch.dtype):
    log = log_from_quaternion(random(*lead, 4).to(dtype))
    assert (log.shape, log.dtype) == ((*lead, 3), dtype)
    back = quaternion_from_log(log)
    assert (back.shape, back.dtype) == ((*lead, 4), dtype)
