import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck
from torch.testing import assert_close

from mambaloc import geometry
from mambaloc.geometry import (
    canonical,
    conjugate,
    is_rotation,
    matrix_from_quaternion,
    multiply,
    normalize,
    quaternion_from_matrix,
    rotate,
    rotation_error_deg,
)

F32, F64 = torch.float32, torch.float64
IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=F64)
ANGLES = [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.1, 1.0]

# Property tests draw whole quaternions, of any length but near zero, and points in a room-sized box.
quaternions = (
    st.tuples(*[st.floats(-10, 10)] * 4)
    .map(lambda q: torch.tensor(q, dtype=F64))
    .filter(lambda q: q.abs().max().item() > 1e-3)
)
points = st.tuples(*[st.floats(-10, 10)] * 3).map(lambda p: torch.tensor(p, dtype=F64))
fast = settings(max_examples=40, deadline=None, derandomize=True)


def random(*shape: int, seed: int = 0, dtype: torch.dtype = F64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def to_scipy(quaternion: Tensor) -> Rotation:
    return Rotation.from_quat(quaternion.double().roll(-1, -1).numpy())


def from_scipy(rotation: Rotation) -> Tensor:
    return torch.from_numpy(rotation.as_quat(canonical=True)).roll(1, -1)


def axis_angle(axis: Tensor, angle: float, below_pi: bool = False) -> Tensor:
    """The quaternion of ``angle``, or of ``pi - angle``, without the rounding of ``pi`` in between."""
    cosine, sine = math.cos(angle / 2), math.sin(angle / 2)
    w, v = (sine, cosine) if below_pi else (cosine, sine)
    unit = axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
    return torch.cat([torch.full_like(unit[..., :1], w), v * unit], dim=-1)


# --- against SciPy ---------------------------------------------------------------------------------------------------


def test_matrix_from_quaternion_equals_scipy():
    q = random(200, 4)
    assert_close(matrix_from_quaternion(q), torch.from_numpy(to_scipy(q).as_matrix()))


def test_quaternion_from_matrix_equals_scipy():
    rotation = Rotation.random(200, random_state=0)
    assert_close(quaternion_from_matrix(torch.from_numpy(rotation.as_matrix())), from_scipy(rotation))


def test_multiply_and_conjugate_equal_scipy():
    a, b = random(200, 4, seed=1), random(200, 4, seed=2)
    assert_close(canonical(multiply(a, b)), from_scipy(to_scipy(a) * to_scipy(b)))
    assert_close(canonical(conjugate(a)), from_scipy(to_scipy(a).inv()))


def test_rotate_equals_scipy():
    q, p = random(200, 4), random(200, 3, seed=1)
    assert_close(rotate(q, p), torch.from_numpy(to_scipy(q).apply(p.numpy())))


def test_canonical_equals_scipy_also_where_w_is_zero():
    signs = torch.tensor(list(itertools.product([-1.0, 0.0, 1.0], repeat=4)), dtype=F64)
    signs = signs[signs.abs().sum(-1) > 0]
    assert_close(canonical(signs), from_scipy(to_scipy(signs)), rtol=0, atol=1e-15)


def test_rotation_error_equals_scipy():
    a, b = random(200, 4, seed=1), random(200, 4, seed=2)
    magnitude = torch.from_numpy((to_scipy(a).inv() * to_scipy(b)).magnitude())
    assert_close(rotation_error_deg(a, b), torch.rad2deg(magnitude), rtol=1e-12, atol=1e-12)


# --- properties ------------------------------------------------------------------------------------------------------


@fast
@given(quaternions)
def test_normalize_keeps_the_direction(q: Tensor):
    unit = normalize(q)
    assert_close(torch.linalg.vector_norm(unit), torch.ones((), dtype=F64))
    assert_close(unit * torch.linalg.vector_norm(q), q)


@fast
@given(quaternions)
def test_q_and_minus_q_are_one_rotation(q: Tensor):
    assert torch.equal(canonical(q), canonical(-q))
    assert canonical(q)[0] >= 0
    assert_close(matrix_from_quaternion(-q), matrix_from_quaternion(q))
    assert rotation_error_deg(q, -q) == 0.0


@fast
@given(quaternions)
def test_conjugate_inverts(q: Tensor):
    assert_close(canonical(multiply(q, conjugate(q))), IDENTITY)


@fast
@given(quaternions, quaternions, quaternions)
def test_multiply_is_associative(a: Tensor, b: Tensor, c: Tensor):
    assert_close(multiply(multiply(a, b), c), multiply(a, multiply(b, c)), rtol=1e-9, atol=1e-9)


@fast
@given(quaternions, quaternions, points)
def test_rotations_act_as_their_matrices(a: Tensor, b: Tensor, p: Tensor):
    assert_close(rotate(a, p), matrix_from_quaternion(a) @ p)
    assert_close(rotate(multiply(a, b), p), rotate(a, rotate(b, p)))


@fast
@given(quaternions)
def test_round_trip_through_a_matrix(q: Tensor):
    # compared as lines: where w is about 0, rounding may choose the other sign
    back = quaternion_from_matrix(matrix_from_quaternion(q))
    assert rotation_error_deg(back, q) < 1e-12
    assert is_rotation(matrix_from_quaternion(q), tolerance=1e-12)


@fast
@given(quaternions, quaternions, quaternions)
def test_rotation_error_is_an_invariant_distance(a: Tensor, b: Tensor, c: Tensor):
    error = rotation_error_deg(a, b)
    assert 0 <= error <= 180
    assert_close(rotation_error_deg(b, a), error)
    assert_close(rotation_error_deg(-3 * a, b), error, rtol=0, atol=1e-10)
    assert_close(rotation_error_deg(multiply(c, a), multiply(c, b)), error, rtol=0, atol=1e-10)


# --- precision -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("dtype", [F32, F64])
def test_rotation_error_resolves_small_angles(angle: float, dtype: torch.dtype):
    axis = random(200, 3)
    expected = torch.full((200,), math.degrees(angle), dtype=dtype)
    from_identity = rotation_error_deg(IDENTITY.to(dtype), axis_angle(axis, angle).to(dtype))
    assert_close(from_identity, expected, rtol=1e-6 if dtype == F32 else 1e-14, atol=0)

    # Away from the identity the format's own spacing limits it: about 1e-5 deg and 3e-14 deg.
    base = normalize(random(200, 4, seed=1))
    generic = rotation_error_deg(base.to(dtype), multiply(base, axis_angle(axis, angle)).to(dtype))
    assert_close(generic, expected, rtol=0, atol=4e-5 if dtype == F32 else 1e-13)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("dtype", [F32, F64])
def test_rotation_error_near_half_a_turn(angle: float, dtype: torch.dtype):
    error = rotation_error_deg(IDENTITY.to(dtype), axis_angle(random(200, 3), angle, below_pi=True).to(dtype))
    expected = torch.full((200,), 180.0 - math.degrees(angle), dtype=dtype)
    assert_close(error, expected, rtol=0, atol=4e-5 if dtype == F32 else 1e-13)
    assert error.max() <= 180.0


@pytest.mark.parametrize("dtype", [F32, F64])
def test_rotation_error_never_passes_180(dtype: torch.dtype):
    half_turns = torch.eye(4, dtype=dtype)[1:]
    a = random(100_000, 1, 4, dtype=dtype)
    error = rotation_error_deg(a, multiply(a, half_turns))
    assert error.max() == 180.0
    assert error.min() > 179.9999


@pytest.mark.parametrize("dtype", [F32, F64])
def test_rotation_error_of_equals_is_exactly_zero(dtype: torch.dtype):
    q = random(1000, 4, dtype=dtype)
    assert rotation_error_deg(q, q).max() == 0.0


@pytest.mark.parametrize("below_pi", [False, True])
@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("dtype", [F32, F64])
def test_quaternion_from_matrix_is_precise_at_every_angle(angle: float, below_pi: bool, dtype: torch.dtype):
    # the coordinate axes and their diagonals make ties between the largest components
    axes = torch.tensor([a for a in itertools.product([-1.0, 0.0, 1.0], repeat=3) if any(a)], dtype=F64)
    q = axis_angle(torch.cat([axes, random(200, 3)]), angle, below_pi)
    back = quaternion_from_matrix(matrix_from_quaternion(q).to(dtype))
    assert rotation_error_deg(back.double(), q).max() < (4e-5 if dtype == F32 else 1e-13)
    assert_close(torch.linalg.vector_norm(back, dim=-1), torch.ones(len(q), dtype=dtype))
    assert (back[:, 0] >= 0).all()


# --- extreme inputs --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [F32, F64])
def test_zero_and_denormal_quaternions_become_the_identity(dtype: torch.dtype):
    tiny = torch.finfo(dtype).tiny
    q = torch.stack([IDENTITY * 0, -IDENTITY * 0, IDENTITY.roll(1) * tiny / 8]).to(dtype).requires_grad_()
    assert torch.equal(normalize(q), IDENTITY.to(dtype).expand(3, 4))
    assert torch.equal(canonical(q), IDENTITY.to(dtype).expand(3, 4))
    (canonical(q) * random(3, 4, dtype=dtype)).sum().backward()
    assert q.grad is not None
    assert torch.equal(q.grad, torch.zeros_like(q))


@pytest.mark.parametrize("scale", ["tiny", "max"])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_length_never_matters(scale: str, dtype: torch.dtype):
    direction = random(50, 4, dtype=dtype)
    direction = direction / direction.abs().amax(-1, keepdim=True)
    q = (direction * getattr(torch.finfo(dtype), scale)).requires_grad_()
    p = random(50, 3, seed=1, dtype=dtype)
    assert_close(normalize(q), normalize(direction))
    assert_close(rotate(q, p), rotate(direction, p))
    assert_close(matrix_from_quaternion(q), matrix_from_quaternion(direction))
    assert rotation_error_deg(q, direction).max() < 4e-5
    (1e-3 * rotation_error_deg(q, random(50, 4, seed=2, dtype=dtype))).sum().backward()
    assert q.grad is not None
    assert q.grad.isfinite().all()


def test_non_finite_quaternions_are_not_hidden():
    q = torch.tensor([[math.nan, 0, 0, 0], [1, 0, 0, math.nan], [math.inf, 0, 0, 0]])
    assert normalize(q).isnan().any(-1).all()
    assert rotation_error_deg(q, torch.eye(4)[0]).isnan().all()


def test_gradient_is_finite_where_the_error_is_extreme():
    target = random(100, 4, dtype=F32)
    half_turn = torch.eye(4)[1]
    for start in (target, -target, 2 * target, multiply(target, half_turn), torch.zeros(100, 4)):
        q = start.clone().requires_grad_()
        rotation_error_deg(q, target).sum().backward()
        assert q.grad is not None
        assert q.grad.isfinite().all()
    q = target.clone().requires_grad_()
    rotation_error_deg(q, target).sum().backward()
    assert q.grad is not None
    assert torch.equal(q.grad, torch.zeros_like(q))


def test_gradient_of_quaternion_from_matrix_is_finite_at_ties():
    signs = torch.tensor([s for s in itertools.product([-1.0, 0.0, 1.0], repeat=4) if any(s)], dtype=F64)
    matrix = matrix_from_quaternion(signs).requires_grad_()
    (quaternion_from_matrix(matrix) * random(len(signs), 4)).sum().backward()
    assert matrix.grad is not None
    assert matrix.grad.isfinite().all()
    assert matrix.grad.abs().amax((-1, -2)).min() > 0


# --- is_rotation -----------------------------------------------------------------------------------------------------


def test_is_rotation_tells_rotations_from_the_rest():
    rotation = matrix_from_quaternion(random(4, seed=3))
    swapped = rotation[[1, 0, 2]]
    nan, infinite, shear = rotation.clone(), rotation.clone(), rotation.clone()
    nan[1, 1], infinite[0, 2], shear[0, 1] = math.nan, math.inf, shear[0, 1] + 0.1
    bad = [swapped, -rotation, nan, infinite, shear, 1.01 * rotation, 0 * rotation, 1e200 * rotation]
    expected = torch.tensor([True] + [False] * len(bad))
    assert torch.equal(is_rotation(torch.stack([rotation, *bad])), expected)


def test_is_rotation_tolerance_is_a_border():
    stretched = torch.diag(torch.tensor([1.0, 1.0, math.sqrt(1.01)], dtype=F64))
    assert is_rotation(stretched, tolerance=0.0101)
    assert not is_rotation(stretched, tolerance=0.0099)


# --- gradients, shapes, export ---------------------------------------------------------------------------------------


def differentiable_cases() -> dict:
    q, other, p = random(6, 4, seed=4), random(6, 4, seed=5), random(6, 3, seed=6)
    each_largest = torch.eye(4, dtype=F64) + 0.1 * random(4, 4, seed=7)
    return {
        "normalize": (normalize, q),
        "canonical": (canonical, q),
        "conjugate": (conjugate, q),
        "multiply": (multiply, q, other),
        "rotate": (rotate, q, p),
        "matrix_from_quaternion": (matrix_from_quaternion, q),
        "quaternion_from_matrix": (quaternion_from_matrix, matrix_from_quaternion(each_largest)),
        "rotation_error_deg": (rotation_error_deg, q, other),
    }


CASES = differentiable_cases()


@pytest.mark.parametrize("name", CASES)
def test_gradcheck(name: str):
    function, *inputs = CASES[name]
    assert gradcheck(function, [x.clone().requires_grad_() for x in inputs])


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("lead", [(), (0,), (5,), (2, 3), (2, 0, 3)])
@pytest.mark.parametrize("name", [*CASES, "is_rotation"])
def test_dtype_and_leading_dimensions_are_kept(name: str, lead: tuple[int, ...], dtype: torch.dtype):
    function, *examples = CASES.get(name, (is_rotation, torch.eye(3).expand(6, 3, 3)))
    inputs = [random(*lead, *x.shape[1:], seed=i, dtype=dtype) for i, x in enumerate(examples)]
    before = [x.clone() for x in inputs]
    result = function(*inputs)
    assert result.dtype == (torch.bool if name == "is_rotation" else dtype)
    assert result.shape == (*lead, *function(*examples).shape[1:])
    assert all(map(torch.equal, inputs, before))
    if result.numel():  # one by one gives what the batch gives
        flat = [x.flatten(0, len(lead) - 1) if lead else x[None] for x in inputs]
        singly = torch.stack([function(*row) for row in zip(*flat, strict=True)])
        assert_close(result, singly.reshape(result.shape))


def test_two_inputs_broadcast():
    q, p, one = random(2, 1, 4), random(5, 3), random(4, seed=1)
    assert_close(rotate(q, p), rotate(q.expand(2, 5, 4), p.expand(2, 5, 3)))
    assert_close(multiply(q, one), multiply(q, one.expand(2, 1, 4)))
    assert rotation_error_deg(one, q).shape == (2, 1)


class EveryFunction(torch.nn.Module):
    def forward(self, q: Tensor, p: Tensor, matrix: Tensor) -> tuple[Tensor, ...]:
        there = matrix_from_quaternion(conjugate(q))
        error = rotation_error_deg(q, multiply(q, canonical(q)))
        return rotate(q, p), there, quaternion_from_matrix(matrix), error, is_rotation(matrix), normalize(q)


def test_export_keeps_the_batch_dynamic():
    inputs = [random(5, 4), random(5, 3), matrix_from_quaternion(random(5, 4, seed=1))]
    batch = torch.export.Dim("batch")
    program = torch.export.export(EveryFunction(), tuple(inputs), dynamic_shapes=[{0: batch}] * 3)
    others = [random(9, 4, seed=2), random(9, 3, seed=3), matrix_from_quaternion(random(9, 4, seed=4))]
    others[0][0] = 0.0
    others[2][1] *= -1.0
    assert_close(program.module()(*others), EveryFunction()(*others))


def test_package_exports_every_public_function():
    modules = (geometry.cameras, geometry.homographies, geometry.poses, geometry.rotations, geometry.solving)
    public = {
        name
        for module in modules
        for name, value in vars(module).items()
        if getattr(value, "__module__", None) == module.__name__ and not name.startswith("_")
    }
    assert public == set(geometry.__all__)
