import math

import pytest
import torch
from scipy.special import rel_entr, softmax

from mambaloc.losses import SoftTargets, cosine_distance, softened_kl
from mambaloc.types import PosePrediction


def test_kl_by_hand():
    # At temperature 1: teacher (1/2, 1/2), student (1/4, 3/4): 1/2 log 2 + 1/2 log 2/3.
    student, teacher = torch.tensor([[0.0, math.log(3)]]), torch.zeros(1, 2)
    expected = 0.5 * math.log(2) + 0.5 * math.log(2 / 3)
    assert softened_kl(student, teacher, 1.0).item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("temperature", [1.0, 10.0])
def test_kl_against_scipy(temperature):
    student, teacher = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    p, q = (softmax(x.numpy() / temperature, axis=1) for x in (teacher, student))
    expected = temperature**2 * rel_entr(p, q).sum(axis=1).mean()
    assert softened_kl(student, teacher, temperature).item() == pytest.approx(expected, rel=1e-9)


def test_kl_is_blind_to_an_equal_shift_of_all_axes():
    student, teacher = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(1))
    shifted = student + 7.0
    torch.testing.assert_close(softened_kl(shifted, teacher, 10.0), softened_kl(student, teacher, 10.0))
    assert softened_kl(teacher + 7.0, teacher, 10.0).item() == pytest.approx(0, abs=1e-4)
    blind, seeing = (SoftTargets(soft)(pose(teacher + 7.0), pose(teacher)) for soft in ("kl", "l2"))
    assert seeing - blind > 7


def test_kl_depends_on_the_scenes_scale():
    """The figures of an error of 1 m along one axis, in a scene of 1 m and in one of 100 m."""
    small = torch.tensor([[0.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    large = torch.tensor([[100.0, 0.0, 0.0]]), torch.tensor([[101.0, 0.0, 0.0]])
    assert softened_kl(*small, 10.0).item() == pytest.approx(0.111, abs=0.005)
    assert softened_kl(*large, 10.0).item() < 0.01 * softened_kl(*small, 10.0).item()


def pose(position_m, quaternion=None):
    return PosePrediction(position_m, torch.eye(4)[:1].expand(len(position_m), 4) if quaternion is None else quaternion)


def test_cosine_by_hand():
    student, teacher = torch.tensor([[2.0, 0.0], [0.0, -3.0]]), torch.tensor([[1.0, 1.0], [0.0, 1.0]])
    assert cosine_distance(student, teacher).item() == pytest.approx(((1 - math.sqrt(0.5)) + 2) / 2)


def test_l2_by_hand_with_learned_weights():
    loss = SoftTargets("l2", s_position=-0.5, s_rotation=-6.5)
    student = pose(torch.tensor([[3.0, 4.0, 0.0]]), torch.tensor([[0.0, 2.0, 0.0, 0.0]]))  # of any length
    teacher = pose(torch.zeros(1, 3), torch.tensor([[-1.0, 0.0, 0.0, 0.0]]))  # of either sign
    expected = 5 * math.exp(0.5) - 0.5 + math.sqrt(2) * math.exp(6.5) - 6.5
    assert loss(student, teacher).item() == pytest.approx(expected, rel=1e-6)
    loss(student, teacher).backward()
    assert loss.s_position.grad.item() == pytest.approx(1 - 5 * math.exp(0.5), rel=1e-6)


@pytest.mark.parametrize(("kwargs", "message"), [({"soft": "mse"}, "'kl' or 'l2'"), ({"temperature": 0}, "positive")])
def test_what_it_does_not_take(kwargs, message):
    with pytest.raises(ValueError, match=message):
        SoftTargets(**kwargs)
