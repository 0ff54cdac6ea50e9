import inspect
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.linalg import expm
from torch import Tensor
from torch.autograd import gradcheck
from torch.testing import assert_close

from mambaloc.nn import MambaMixer, selective_scan

F32, F64 = torch.float32, torch.float64
BOTH = pytest.mark.parametrize("discretisation", ["euler", "zoh"])


def random(*shape: int, seed: int = 0, dtype: torch.dtype = F64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def random_mixer(width: int, dtype: torch.dtype = F32, **kwargs) -> MambaMixer:
    """A mixer whose A and D also differ from channel to channel, as they do after training."""
    torch.manual_seed(width)
    mixer = MambaMixer(width, **kwargs)
    with torch.no_grad():
        mixer.A_log.add_(torch.randn_like(mixer.A_log), alpha=0.3)
        mixer.D.copy_(torch.randn_like(mixer.D))
    return mixer.to(dtype)


def scan_inputs(batch: int, length: int, inner: int, state: int) -> dict[str, Tensor]:
    return {
        "x_BLE": random(batch, length, inner, seed=1),
        "dt_BLE": F.softplus(random(batch, length, inner, seed=2)),
        "A_ES": -random(inner, state, seed=3).exp(),
        "B_BLS": random(batch, length, state, seed=4),
        "C_BLS": random(batch, length, state, seed=5),
        "D_E": random(inner, seed=6),
    }


def relative_error(actual: Tensor, expected: Tensor) -> float:
    return ((actual - expected).abs().max() / expected.abs().max()).item()


# --- the closed form -------------------------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize(("dtype", "tolerance"), [(F32, 1e-6), (F64, 1e-12)])
@pytest.mark.parametrize(
    "shape",
    [
        {"width": 4},
        {"width": 40, "d_state": 5},
        {"width": 256},
        {"width": 1024},
        {"width": 24, "expand": 2, "d_conv": 2, "dt_rank": 7},
        {"width": 24, "expand": 3, "d_conv": 3},
    ],
    ids=str,
)
def test_last_of_two_is_the_general_forward(shape, dtype, tolerance, discretisation):
    mixer = random_mixer(**shape, dtype=dtype, discretisation=discretisation)
    first, last = random(7, shape["width"], seed=1, dtype=dtype), random(7, shape["width"], seed=2, dtype=dtype)
    with torch.no_grad():
        expected = mixer(torch.stack((first, last), dim=1))[:, 1]
        assert relative_error(mixer.last_of_two(first, last), expected) <= tolerance
        assert relative_error(mixer.last_of_two(last, first), expected) > 0.01  # the order matters


@BOTH
def test_last_of_two_has_the_gradients_of_the_general_forward(discretisation):
    mixer = random_mixer(12, F64, discretisation=discretisation)
    first, last, weight = (random(3, 12, seed=i) for i in range(3))
    grads = []
    for output in (mixer.last_of_two(first, last), mixer(torch.stack((first, last), dim=1))[:, 1]):
        grads.append(torch.autograd.grad((output * weight).sum(), list(mixer.parameters())))
    for (name, _), closed, general in zip(mixer.named_parameters(), *grads, strict=True):
        assert_close(closed, general, rtol=1e-10, atol=1e-12, msg=lambda m, name=name: f"{name}: {m}")


@BOTH
def test_last_of_two_gradcheck(discretisation):
    mixer = random_mixer(3, F64, d_state=2, discretisation=discretisation)
    names = [f"mixer.{name}" for name, _ in mixer.named_parameters()]

    def run(first: Tensor, last: Tensor, *parameters: Tensor) -> Tensor:
        replaced = dict(zip(names, parameters, strict=True))
        return torch.func.functional_call(_Closed(mixer), replaced, (first, last))

    inputs = [random(2, 3, seed=1), random(2, 3, seed=2), *(p.detach().clone() for p in mixer.parameters())]
    assert gradcheck(run, tuple(t.requires_grad_() for t in inputs))


class _Closed(torch.nn.Module):
    def __init__(self, mixer: MambaMixer) -> None:
        super().__init__()
        self.mixer = mixer

    def forward(self, first: Tensor, last: Tensor) -> Tensor:
        return self.mixer.last_of_two(first, last)


# --- the scan --------------------------------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("length", [1, 2, 9])
def test_selective_scan_is_the_recurrence(length, discretisation):
    inputs = scan_inputs(batch=2, length=length, inner=3, state=4)
    x, dt, A, B, C, D = (t.numpy() for t in inputs.values())
    expected = np.zeros_like(x)
    for b in range(x.shape[0]):
        for e in range(x.shape[2]):
            h = np.zeros(A.shape[1])
            for t in range(length):
                for s in range(A.shape[1]):
                    a_bar = math.exp(dt[b, t, e] * A[e, s])
                    gain = (a_bar - 1) / A[e, s] if discretisation == "zoh" else dt[b, t, e]
                    h[s] = a_bar * h[s] + gain * B[b, t, s] * x[b, t, e]
                expected[b, t, e] = sum(C[b, t, s] * h[s] for s in range(len(h))) + D[e] * x[b, t, e]
    actual = selective_scan(**inputs, discretisation=discretisation)
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-11, atol=1e-13)


def test_zoh_is_the_exact_solution_for_a_held_input():
    # x' = A x + B u with u held for dt: expm of [[A, B], [0, 0]] dt advances (x, u) exactly.
    inputs = scan_inputs(batch=1, length=4, inner=2, state=3)
    x, dt, A, B, C, D = (t.numpy() for t in inputs.values())
    expected = np.zeros_like(x)
    for e in range(2):
        h = np.zeros(3)
        for t in range(4):
            augmented = np.zeros((4, 4))
            augmented[:3, :3], augmented[:3, 3] = np.diag(A[e]), B[0, t]
            h = (expm(augmented * dt[0, t, e]) @ np.append(h, x[0, t, e]))[:3]
            expected[0, t, e] = C[0, t] @ h + D[e] * x[0, t, e]
    np.testing.assert_allclose(selective_scan(**inputs, discretisation="zoh").numpy(), expected, rtol=1e-11)
    euler = selective_scan(**inputs).numpy()
    assert np.abs(euler - expected).max() > 0.01 * np.abs(expected).max()


def test_zoh_keeps_its_digits_at_tiny_steps():
    inputs = scan_inputs(batch=1, length=1, inner=2, state=3)
    inputs["dt_BLE"] = torch.full((1, 1, 2), 1e-6, dtype=F64)
    inputs["D_E"] = torch.zeros(2, dtype=F64)
    single = {name: value.float() for name, value in inputs.items()}
    assert relative_error(selective_scan(**single, discretisation="zoh").double(), selective_scan(**inputs)) < 1e-5


@BOTH
def test_outputs_never_depend_on_later_tokens(discretisation):
    mixer = random_mixer(8, F64, discretisation=discretisation)
    x = random(2, 6, 8)
    changed = x.clone()
    changed[:, 4:] += 1
    with torch.no_grad():
        before, after = mixer(x), mixer(changed)
    assert_close(before[:, :4], after[:, :4], rtol=0, atol=1e-14)
    assert ((before[:, 4:] - after[:, 4:]).abs().amax(-1) > 1e-6).all()


# --- against the Mamba of Hugging Face transformers ------------------------------------------------------------------


@pytest.mark.parametrize("expand", [1, 2])
@pytest.mark.parametrize("length", [1, 2, 17])
def test_mixer_is_the_reference_mixer(length, expand):
    modeling = pytest.importorskip("transformers.models.mamba.modeling_mamba")
    width = 40
    config = modeling.MambaConfig(
        hidden_size=width, state_size=16, conv_kernel=4, expand=expand, time_step_rank=3, use_bias=False,
        use_conv_bias=True, num_hidden_layers=1,
    )  # fmt: skip
    reference = modeling.MambaMixer(config, layer_idx=0).eval()
    mixer = random_mixer(width, expand=expand)
    assert sorted(reference.state_dict()) == sorted(mixer.state_dict())
    reference.load_state_dict(mixer.state_dict())
    x = random(3, length, width, dtype=F32)
    slow_path = getattr(reference, "slow_forward", reference.forward)  # transformers 5 folded it into forward
    with torch.no_grad():
        expected = slow_path(x)
        assert relative_error(mixer(x), expected) < 1e-6
        if length == 2:
            assert relative_error(mixer.last_of_two(x[:, 0], x[:, 1]), expected[:, 1]) < 1e-6


# --- initialisation, arguments ---------------------------------------------------------------------------------------


def test_initial_step_sizes_decays_and_skip():
    torch.manual_seed(0)
    mixer = MambaMixer(512)
    step = F.softplus(mixer.dt_proj.bias.detach().double())
    assert step.min() >= 1e-3 * (1 - 1e-4)
    assert step.max() <= 1e-1 * (1 + 1e-4)
    assert step.log().mean().item() == pytest.approx(math.log(1e-2), abs=0.25)  # log-uniform: 6 standard errors
    assert_close(-mixer.A_log.exp(), -torch.arange(1.0, 17.0).expand(512, 16), rtol=1e-6, atol=0)
    assert (mixer.D == 1).all()
    bound = mixer.dt_rank**-0.5
    assert mixer.dt_rank == 32
    assert 0.9 * bound < mixer.dt_proj.weight.abs().max() <= bound


@pytest.mark.parametrize(("width", "rank"), [(1, 1), (16, 1), (17, 2), (256, 16)])
def test_step_size_rank_rounds_up(width, rank):
    assert MambaMixer(width).dt_rank == rank


def test_decay_and_skip_ask_for_no_weight_decay():
    mixer = MambaMixer(8)
    assert mixer.no_weight_decay() == {"A_log", "D"}
    assert all(isinstance(getattr(mixer, name), torch.nn.Parameter) for name in mixer.no_weight_decay())


@pytest.mark.parametrize(
    ("kwargs", "message"), [({"discretisation": "bilinear"}, "bilinear"), ({"d_conv": 1}, "d_conv")]
)
def test_wrong_arguments_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        MambaMixer(8, **kwargs)


def test_euler_is_the_default():
    assert inspect.signature(MambaMixer).parameters["discretisation"].default == "euler"
    inputs = scan_inputs(1, 3, 2, 2)
    assert_close(selective_scan(**inputs), selective_scan(**inputs, discretisation="euler"), rtol=0, atol=0)
