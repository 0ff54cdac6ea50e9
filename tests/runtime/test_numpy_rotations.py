"""NumPy rotations against SciPy, at random rotations, half turns and tiny angles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.runtime import rotations

RNG = np.random.default_rng(0)
AXES = np.concatenate([np.eye(3), RNG.normal(size=(20, 3))])
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)
ANGLES = np.array([0.0, 1e-9, 1e-4, 0.5, np.pi / 2, np.pi - 1e-7, np.pi])
VECTORS = (AXES[:, None] * ANGLES[:, None]).reshape(-1, 3)
SCIPY = Rotation.from_rotvec(VECTORS)
QUATERNIONS = SCIPY.as_quat(canonical=True, scalar_first=True)


def test_conversions_equal_scipys():
    shape = (len(AXES), len(ANGLES))
    matrices = rotations.matrix_from_quaternion((3 * QUATERNIONS).reshape(*shape, 4))
    np.testing.assert_allclose(matrices.reshape(-1, 3, 3), SCIPY.as_matrix(), atol=1e-14)
    found = rotations.quaternion_from_matrix(matrices)
    assert found.shape == (*shape, 4)
    np.testing.assert_allclose(rotations.matrix_from_quaternion(found), matrices, atol=1e-14)
    np.testing.assert_allclose(
        rotations.quaternion_from_rotation_vector(VECTORS),
        Rotation.from_rotvec(VECTORS).as_quat(scalar_first=True),
        atol=1e-15,
    )
    vectors = rotations.rotation_vector_from_quaternion(-QUATERNIONS)
    np.testing.assert_allclose(Rotation.from_rotvec(vectors).as_matrix(), SCIPY.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), SCIPY.magnitude(), atol=1e-14)


def test_products_and_angles_equal_scipys():
    a, b = SCIPY, Rotation.random(len(SCIPY), rng=1)
    product = rotations.multiply(QUATERNIONS, b.as_quat(scalar_first=True))
    np.testing.assert_allclose(rotations.matrix_from_quaternion(product), (a * b).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(
        rotations.matrix_from_quaternion(rotations.conjugate(QUATERNIONS)), a.inv().as_matrix(), atol=1e-14
    )
    between = rotations.rotation_vector_between(-QUATERNIONS[:, None], b.as_quat(scalar_first=True))  # all by all
    expected = (a[3].inv() * b[5]).as_rotvec()
    np.testing.assert_allclose(between[3, 5], expected, atol=1e-14)
    apart = rotations.rotation_error_deg(QUATERNIONS, -b.as_quat(scalar_first=True))
    np.testing.assert_allclose(apart, np.degrees((a.inv() * b).magnitude()), atol=1e-12)


def test_a_tiny_angle_keeps_its_digits():
    near = rotations.quaternion_from_rotation_vector([0.0, 0.0, 1e-9])
    assert rotations.rotation_error_deg([1.0, 0, 0, 0], near) == pytest.approx(np.degrees(1e-9), rel=1e-9)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([-2.0, 0, 0, 0], [1, 0, 0, 0]),
        ([0.0, -3, 0, 0], [0, 1, 0, 0]),
        ([0.0, 0, 0, -1], [0, 0, 0, 1]),
        ([0.0, 0.6, -0.8, 0], [0, 0.6, -0.8, 0]),
    ],
)
def test_of_two_signs_the_first_component_that_is_not_zero_decides(given, expected):
    np.testing.assert_allclose(rotations.canonical(given), expected)


def test_what_is_a_rotation():
    flipped, skewed, broken = np.diag([1.0, 1, -1]), np.eye(3) + 0.1, np.full((3, 3), np.nan)
    several = np.stack([np.eye(3), flipped, skewed, broken, SCIPY.as_matrix()[30]])
    assert rotations.is_rotation(several).tolist() == [True, False, False, False, True]
    assert rotations.is_rotation(np.eye(3) * 1.004, tolerance=1e-2)
    assert not rotations.is_rotation(np.eye(3) * 1.004, tolerance=1e-3)
