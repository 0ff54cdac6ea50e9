import math

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from mambaloc.errors import InputError
from mambaloc.losses import FixedWeights, LearnedWeights, build_loss
from mambaloc.types import PoseBatch, PosePrediction

# Two frames. Position offsets (3, 4, 0) and (0, 0, -1): L2 5 and 1, L1 7 and 1. True rotations are the identity;
# the predictions, of length 2 and 1, are 90 deg about x and 180 deg about y:
# L2 2 sin(22.5 deg) and sqrt(2), L1 1 - 1/sqrt(2) + 1/sqrt(2) = 1 and 2.
ROOT = math.sqrt(0.5)
OFFSETS_M = [[3.0, 4.0, 0.0], [0.0, 0.0, -1.0]]
PREDICTED = [[2 * ROOT, 2 * ROOT, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
DISTANCES = {
    "l2": ((5 + 1) / 2, (2 * math.sin(math.pi / 8) + math.sqrt(2)) / 2),
    "l1": ((7 + 1) / 2, (1 + 2) / 2),
}


def target(quaternion: list[list[float]]) -> PoseBatch:
    count = len(quaternion)
    return PoseBatch(
        torch.zeros(count, 3, 2, 2), torch.full((count, 3), 10.0), torch.tensor(quaternion), torch.arange(count)
    )


def two_frames(sign: float = 1.0) -> tuple[PosePrediction, PoseBatch]:
    prediction = PosePrediction(torch.tensor(OFFSETS_M) + 10.0, sign * torch.tensor(PREDICTED))
    return prediction, target([[1.0, 0.0, 0.0, 0.0]] * 2)


@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_fixed_weights_by_hand(norm):
    position_m, rotation = DISTANCES[norm]
    loss = FixedWeights(beta=20.0, norm=norm)(*two_frames())
    assert loss.item() == pytest.approx(position_m + 20 * rotation, rel=1e-6)


@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_learned_weights_by_hand(norm):
    position_m, rotation = DISTANCES[norm]
    loss = LearnedWeights(s_position=-0.5, s_rotation=-3.0, norm=norm)(*two_frames())
    expected = position_m * math.exp(0.5) - 0.5 + rotation * math.exp(3.0) - 3.0
    assert loss.item() == pytest.approx(expected, rel=1e-6)


def test_paper_defaults():
    loss = LearnedWeights()
    assert (loss.s_position.item(), loss.s_rotation.item(), loss.norm, loss.nearest_sign) == (-0.5, -6.5, "l2", False)


def test_gradient_of_the_learned_weights():
    loss = LearnedWeights(s_position=0.3, s_rotation=-2.0)
    loss(*two_frames()).backward()
    position_m, rotation = DISTANCES["l2"]
    assert loss.s_position.grad.item() == pytest.approx(1 - position_m * math.exp(-0.3), rel=1e-5)
    assert loss.s_rotation.grad.item() == pytest.approx(1 - rotation * math.exp(2.0), rel=1e-5)


def test_learned_weights_settle_where_they_are_the_log_distances():
    # d/ds (d exp(-s) + s) = 0 at s = log d
    position_m, rotation = DISTANCES["l2"]
    loss = LearnedWeights(math.log(position_m), math.log(rotation))
    loss(*two_frames()).backward()
    assert abs(loss.s_position.grad.item()) < 1e-6
    assert abs(loss.s_rotation.grad.item()) < 1e-6


def test_gradient_with_respect_to_the_prediction():
    torch.manual_seed(0)
    true = target(torch.nn.functional.normalize(torch.randn(3, 4), dim=-1).tolist())
    true.position_m, true.quaternion = true.position_m.double(), true.quaternion.double()
    loss = LearnedWeights(0.1, -1.0).double()

    def run(position_m: Tensor, quaternion: Tensor) -> Tensor:
        return loss(PosePrediction(position_m, quaternion), true)

    inputs = (torch.randn(3, 3, dtype=torch.float64), torch.randn(3, 4, dtype=torch.float64))
    assert gradcheck(run, tuple(i.requires_grad_() for i in inputs))


@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_a_perfect_prediction_gives_the_sum_of_log_variances_and_finite_gradients(norm):
    true = target([[0.6, 0.0, 0.8, 0.0]])
    position_m, quaternion = true.position_m.clone().requires_grad_(), (3 * true.quaternion).requires_grad_()
    loss = LearnedWeights(norm=norm)(PosePrediction(position_m, quaternion), true)
    assert loss.item() == pytest.approx(-7.0, abs=1e-3)  # exp(6.5) magnifies the rounding of 3q / |3q|
    loss.backward()
    assert position_m.grad.isfinite().all()
    assert quaternion.grad.isfinite().all()


def test_learned_loss_may_be_negative_and_the_fixed_one_not():
    true = target([[1.0, 0.0, 0.0, 0.0]])
    perfect = PosePrediction(true.position_m, true.quaternion)
    assert LearnedWeights(-0.5, -6.5)(perfect, true).item() == pytest.approx(-7.0)
    assert FixedWeights()(perfect, true).item() == 0.0


@pytest.mark.parametrize("build", [FixedWeights, LearnedWeights])
@pytest.mark.parametrize("scale", [1e-3, 0.5, 40.0])
def test_the_length_of_a_predicted_quaternion_does_not_matter(build, scale):
    loss, (prediction, true) = build(), two_frames()
    scaled = PosePrediction(prediction.position_m, prediction.quaternion * scale)
    assert loss(scaled, true).item() == pytest.approx(loss(prediction, true).item(), rel=1e-6)


@pytest.mark.parametrize("build", [FixedWeights, LearnedWeights])
@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_nearest_sign_makes_q_and_minus_q_one(build, norm):
    near, plain = build(norm=norm, nearest_sign=True), build(norm=norm)
    straight, negated = two_frames(), two_frames(sign=-1.0)
    assert near(*straight).item() == pytest.approx(plain(*straight).item(), rel=1e-6)
    assert near(*negated).item() == pytest.approx(near(*straight).item(), rel=1e-6)
    assert plain(*negated).item() > plain(*straight).item() + 0.1


def test_nearest_sign_is_chosen_frame_by_frame():
    true = target([[1.0, 0.0, 0.0, 0.0]] * 2)
    mixed = PosePrediction(true.position_m, torch.tensor([[1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]]))
    assert FixedWeights(nearest_sign=True)(mixed, true).item() == 0.0
    assert FixedWeights(beta=1.0)(mixed, true).item() == pytest.approx(1.0)  # mean of 0 and 2


def test_log_variances_are_parameters_that_ask_for_no_weight_decay():
    loss = LearnedWeights()
    assert loss.no_weight_decay() == {name for name, _ in loss.named_parameters()} == {"s_position", "s_rotation"}
    assert not list(FixedWeights().parameters())


# --- by name ---------------------------------------------------------------------------------------------------------


def test_losses_are_built_by_name():
    learned = build_loss("learned_weights", {"s_rotation": -3, "norm": "l1", "nearest_sign": True})
    assert isinstance(learned, LearnedWeights)
    assert (learned.s_rotation.item(), learned.norm, learned.nearest_sign) == (-3.0, "l1", True)
    assert isinstance(build_loss("fixed_weights"), FixedWeights)


@pytest.mark.parametrize(
    ("name", "args", "match"),
    [
        ("learned", None, "learned_weights, fixed_weights"),
        ("learned_weights", {"beta": 1.0}, "beta"),
        ("learned_weights", {"s_position": "low"}, "low"),
        ("learned_weights", {"norm": "L1"}, "L1"),
        ("fixed_weights", {"norm": "huber"}, "huber"),
        ("fixed_weights", {"beta": None}, "beta"),
    ],
)
def test_unknown_losses_and_arguments_are_refused_in_one_line(name, args, match):
    with pytest.raises(InputError, match=match) as error:
        build_loss(name, args)
    assert "\n" not in str(error.value)
