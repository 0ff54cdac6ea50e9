import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck
from torch.testing import assert_close

from mambaloc.geometry import (
    canonical,
    compose,
    inverse,
    matrix_from_pose,
    pose_from_matrix,
    position_error_m,
    rotation_error_deg,
    transform,
)
from mambaloc.types import Pose

F32, F64 = torch.float32, torch.float64

coordinates = st.tuples(*[st.floats(-100, 100)] * 3).map(lambda t: torch.tensor(t, dtype=F64))
unit_quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .map(lambda q: torch.tensor(q, dtype=F64))
    .filter(lambda q: q.abs().max().item() > 1e-3)
    .map(canonical)
)
poses = st.builds(Pose, coordinates, unit_quaternions)
fast = settings(max_examples=40, deadline=None, derandomize=True)


def random(*shape: int, seed: int = 0, dtype: torch.dtype = F64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def random_pose(*lead: int, seed: int = 0, dtype: torch.dtype = F64) -> Pose:
    return Pose(random(*lead, 3, seed=seed, dtype=dtype), canonical(random(*lead, 4, seed=seed + 100, dtype=dtype)))


def scipy_matrix(pose: Pose) -> Tensor:
    """An oracle that shares no code with the package."""
    matrix = np.tile(np.eye(4), (len(pose.position_m), 1, 1))
    matrix[:, :3, :3] = Rotation.from_quat(pose.quaternion.roll(-1, -1).numpy()).as_matrix()
    matrix[:, :3, 3] = pose.position_m.numpy()
    return torch.from_numpy(matrix)


def assert_same(a: Pose, b: Pose, position_m: float = 1e-9, rotation_deg: float = 1e-9) -> None:
    assert position_error_m(a.position_m, b.position_m).max() <= position_m
    assert rotation_error_deg(a.quaternion, b.quaternion).max() <= rotation_deg


def assert_unit_canonical(pose: Pose) -> None:
    assert_close(pose.quaternion, canonical(pose.quaternion))


# --- against SciPy and NumPy -----------------------------------------------------------------------------------------


def test_matrix_from_pose_equals_scipy():
    pose = random_pose(50)
    assert_close(matrix_from_pose(pose), scipy_matrix(pose))


def test_pose_from_matrix_equals_scipy():
    pose = random_pose(50)
    back = pose_from_matrix(scipy_matrix(pose))
    assert_close(back.position_m, pose.position_m)
    assert_close(back.quaternion, pose.quaternion)
    assert_close(pose_from_matrix(scipy_matrix(pose)[:, :3]).quaternion, pose.quaternion)


def test_compose_is_the_matrix_product():
    a, b = random_pose(50, seed=1), random_pose(50, seed=2)
    assert_close(matrix_from_pose(a @ b), scipy_matrix(a) @ scipy_matrix(b))


def test_inverse_is_the_matrix_inverse():
    pose = random_pose(50)
    assert_close(matrix_from_pose(pose.inverse()), torch.linalg.inv(scipy_matrix(pose)))


def test_the_functions_of_before_answer_alike_and_warn():
    a, b = random_pose(3, seed=1), random_pose(3, seed=2)
    with pytest.warns(DeprecationWarning, match="a_from_b @ b_from_c"):
        assert_same(compose(a, b), a @ b)
    with pytest.warns(DeprecationWarning, match=r"a_from_b\.inverse\(\)"):
        assert_same(inverse(a), a.inverse())


def test_transform_is_the_matrix_on_homogeneous_points():
    pose, points = random_pose(50), random(50, 3, seed=1)
    homogeneous = torch.cat([points, torch.ones(50, 1, dtype=F64)], dim=-1)
    assert_close(transform(pose, points), (scipy_matrix(pose) @ homogeneous[..., None])[:, :3, 0])


def test_camera_center_is_the_position():
    world_from_cam = random_pose(50)
    assert_close(transform(world_from_cam, torch.zeros(3, dtype=F64)), world_from_cam.position_m)
    assert_close(transform(world_from_cam.inverse(), world_from_cam.position_m), torch.zeros(50, 3, dtype=F64))


# --- properties ------------------------------------------------------------------------------------------------------


@fast
@given(poses, poses, poses)
def test_compose_is_associative(a: Pose, b: Pose, c: Pose):
    assert_same((a @ b) @ c, a @ (b @ c))


@fast
@given(poses)
def test_inverse_cancels_on_both_sides(pose: Pose):
    identity = Pose(torch.zeros(3, dtype=F64), torch.eye(4, dtype=F64)[0])
    assert_same(pose @ pose.inverse(), identity)
    assert_same(pose.inverse() @ pose, identity)
    assert_same(pose.inverse().inverse(), pose)


@fast
@given(poses, poses, coordinates)
def test_transform_follows_composition(a: Pose, b: Pose, point: Tensor):
    assert_close(transform(a @ b, point), transform(a, transform(b, point)), rtol=1e-9, atol=1e-9)


@fast
@given(poses)
def test_round_trip_through_a_matrix(pose: Pose):
    assert_same(pose_from_matrix(matrix_from_pose(pose)), pose, position_m=0.0, rotation_deg=1e-12)


@fast
@given(poses, poses, st.floats(-5, 5).filter(lambda s: abs(s) > 0.1))
def test_quaternion_length_and_sign_do_not_matter(a: Pose, b: Pose, scale: float):
    scaled = Pose(a.position_m, scale * a.quaternion)
    assert_same(scaled @ b, a @ b)
    assert_same(scaled.inverse(), a.inverse())
    for result in (scaled @ b, scaled.inverse(), pose_from_matrix(matrix_from_pose(scaled))):
        assert_unit_canonical(result)


def test_long_chains_do_not_drift():
    step = random_pose(1, dtype=F32)
    pose = step
    for _ in range(1000):
        pose = pose @ step
    assert_close(torch.linalg.vector_norm(pose.quaternion, dim=-1), torch.ones(1), rtol=0, atol=2e-7)


# --- position error --------------------------------------------------------------------------------------------------


def test_position_error_is_the_euclidean_distance():
    a, b = random(50, 3, seed=1), random(50, 3, seed=2)
    assert_close(position_error_m(a, b), torch.from_numpy(np.linalg.norm(a.numpy() - b.numpy(), axis=-1)))


def test_position_error_has_zero_gradient_at_zero():
    target = random(5, 3)
    a = target.clone().requires_grad_()
    position_error_m(a, target).sum().backward()
    assert a.grad is not None
    assert torch.equal(a.grad, torch.zeros_like(a))


# --- gradients, shapes, export ---------------------------------------------------------------------------------------


def parts(pose: Pose) -> tuple[Tensor, Tensor]:
    return pose.position_m, pose.quaternion


POSE, OTHER, POINTS = parts(random_pose(4, seed=1)), parts(random_pose(4, seed=2)), random(4, 3, seed=3)
CASES = {
    "compose": (lambda p, q, r, s: parts(Pose(p, q) @ Pose(r, s)), *POSE, *OTHER),
    "inverse": (lambda p, q: parts(Pose(p, q).inverse()), *POSE),
    "transform": (lambda p, q, x: transform(Pose(p, q), x), *POSE, POINTS),
    "matrix_from_pose": (lambda p, q: matrix_from_pose(Pose(p, q)), *POSE),
    "pose_from_matrix": (lambda m: parts(pose_from_matrix(m)), matrix_from_pose(Pose(*POSE))),
    "position_error_m": (position_error_m, POSE[0], OTHER[0]),
}


@pytest.mark.parametrize("name", CASES)
def test_gradcheck(name: str):
    function, *inputs = CASES[name]
    assert gradcheck(function, [x.clone().requires_grad_() for x in inputs])


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("lead", [(), (0,), (5,), (2, 3), (2, 0, 3)])
@pytest.mark.parametrize("name", CASES)
def test_dtype_and_leading_dimensions_are_kept(name: str, lead: tuple[int, ...], dtype: torch.dtype):
    function, *examples = CASES[name]
    inputs = [random(*lead, *x.shape[1:], seed=i, dtype=dtype) for i, x in enumerate(examples)]
    results, expected = function(*inputs), function(*examples)
    if isinstance(results, Tensor):
        results, expected = (results,), (expected,)
    for result, like in zip(results, expected, strict=True):
        assert result.dtype == dtype
        assert result.shape == (*lead, *like.shape[1:])


def test_points_broadcast_under_each_pose():
    pose, points = random_pose(2), random(2, 5, 3, seed=1)
    together = transform(Pose(pose.position_m[:, None], pose.quaternion[:, None]), points)
    apart = [transform(Pose(p, q), x) for p, q, x in zip(pose.position_m, pose.quaternion, points, strict=True)]
    assert_close(together, torch.stack(apart))
    one = random_pose(seed=7)
    assert (one @ pose).position_m.shape == (2, 3)
    assert (one @ pose).quaternion.shape == (2, 4)


class EveryFunction(torch.nn.Module):
    def forward(self, position_m: Tensor, quaternion: Tensor) -> tuple[Tensor, ...]:
        pose = Pose(position_m, quaternion)
        chained = pose @ (pose @ pose.inverse())
        back = pose_from_matrix(matrix_from_pose(chained))
        return back.quaternion, transform(back, position_m), position_error_m(back.position_m, position_m)


def test_export_keeps_the_batch_dynamic():
    batch = torch.export.Dim("batch")
    program = torch.export.export(EveryFunction(), parts(random_pose(5)), dynamic_shapes=[{0: batch}] * 2)
    others = parts(random_pose(9, seed=1))
    assert_close(program.module()(*others), EveryFunction()(*others))
