import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mambaloc.geometry import align_directions, grid_rays, intersect_rays, rotation_error_deg

# float32 loses the last digits where two rotations are nearly as good
TOLERANCE_DEG = {torch.float64: 1e-6, torch.float32: 0.02}


def directions(rng, count, cells=48):
    vectors = rng.normal(size=(count, cells, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def noisy_directions(noise, count=200, seed=0):
    """Directions in the camera, in the world with noise, weights, and SciPy's best rotations, wxyz."""
    rng = np.random.default_rng(seed)
    camera, truth = directions(rng, count), Rotation.random(count, rng=rng)
    world = np.stack([r.apply(c) for r, c in zip(truth, camera, strict=True)]) + noise * rng.normal(size=camera.shape)
    world /= np.linalg.norm(world, axis=-1, keepdims=True)
    weights = rng.dirichlet(np.ones(camera.shape[1]), count)
    best = [Rotation.align_vectors(d, c, w)[0] for c, d, w in zip(camera, world, weights, strict=True)]
    return camera, world, weights, np.stack([r.as_quat(scalar_first=True) for r in best])


@pytest.mark.parametrize("dtype", TOLERANCE_DEG)
@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
def test_rotation_is_scipys_best(noise, dtype):
    *given, expected = noisy_directions(noise)
    actual = align_directions(*(torch.from_numpy(each).to(dtype) for each in given))
    assert rotation_error_deg(actual.double(), torch.from_numpy(expected)).max() < TOLERANCE_DEG[dtype]
    assert (actual[:, 0] >= 0).all()


def test_cells_of_a_long_lens_still_determine_the_rotation():
    rng = np.random.default_rng(1)
    camera = directions(rng, 50) * (0.2, 0.2, 0) + (0, 0, 1)  # of 23 degrees
    camera /= np.linalg.norm(camera, axis=-1, keepdims=True)
    truth = Rotation.random(50, rng=rng)
    world = np.stack([r.apply(c) for r, c in zip(truth, camera, strict=True)])
    weights = torch.full(camera.shape[:2], 1 / camera.shape[1])
    actual = align_directions(torch.from_numpy(camera).float(), torch.from_numpy(world).float(), weights)
    expected = torch.from_numpy(truth.as_quat(scalar_first=True))
    assert rotation_error_deg(actual.double(), expected).max() < 0.05


def test_a_reflection_is_never_returned():
    camera = torch.from_numpy(directions(np.random.default_rng(2), 8))
    mirrored = camera * torch.tensor([1.0, 1.0, -1.0])
    weights = torch.full(camera.shape[:2], 1 / 48, dtype=torch.float64)
    best = [Rotation.align_vectors(d, c)[0] for c, d in zip(camera.numpy(), mirrored.numpy(), strict=True)]
    expected = torch.from_numpy(np.stack([r.as_quat(scalar_first=True) for r in best]))
    assert rotation_error_deg(align_directions(camera, mirrored, weights), expected).max() < 1e-5


def test_gradient_of_the_rotation_is_the_numerical_one():
    camera, world, weights, _ = noisy_directions(0.3, count=3)
    given = [torch.from_numpy(each).requires_grad_() for each in (camera, world, weights)]
    assert torch.autograd.gradcheck(align_directions, given)


def test_parallel_directions_give_a_finite_rotation_that_turns_one_into_the_other():
    camera = torch.tensor([0.0, 0.0, 1.0]).expand(1, 4, 3)
    world = torch.tensor([1.0, 0.0, 0.0]).expand(1, 4, 3)
    quaternion = align_directions(camera, world, torch.full((1, 4), 0.25))
    turned = Rotation.from_quat(quaternion[0].numpy(), scalar_first=True).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(turned, (1, 0, 0), atol=1e-3)


@pytest.mark.parametrize("prior_weight", [0.0, 0.05])
def test_position_is_scipys_least_squares(prior_weight):
    rng = np.random.default_rng(3)
    rays, points, prior = directions(rng, 5), rng.normal(size=(5, 48, 3)), rng.normal(size=(5, 3))
    weights = rng.dirichlet(np.ones(48), 5)
    given = (torch.from_numpy(each) for each in (rays, points, weights, prior))
    actual = intersect_rays(*given, prior_weight).numpy()
    for row in range(5):

        def residuals(center, row=row):
            offset = points[row] - center
            across = offset - (offset * rays[row]).sum(-1, keepdims=True) * rays[row]
            pull = np.sqrt(prior_weight) * (center - prior[row])
            return np.concatenate(((np.sqrt(weights[row])[:, None] * across).ravel(), pull))

        np.testing.assert_allclose(actual[row], least_squares(residuals, np.zeros(3)).x, atol=1e-6)


def test_exact_points_give_the_camera_in_single_precision():
    rng = np.random.default_rng(4)
    center, rays = rng.normal(size=(50, 1, 3)), directions(rng, 50)
    points = center + rays * rng.uniform(1, 5, size=(50, 48, 1))
    given = [torch.from_numpy(each).float() for each in (rays, points, np.full((50, 48), 1 / 48))]
    actual = intersect_rays(*given, torch.zeros(50, 3), 0.0)
    np.testing.assert_allclose(actual.numpy(), center[:, 0], atol=1e-4)


def test_rays_meet_the_cells_centers():
    intrinsics = torch.tensor([[[100.0, 0, 63.5], [0, 90.0, 47.5], [0, 0, 1]]])
    rays = grid_rays(intrinsics, (96, 128), (6, 8))
    assert rays.shape == (1, 48, 3)
    torch.testing.assert_close(rays.norm(dim=-1), torch.ones(1, 48))
    # the cell at row 2, column 5 spans rows 32 to 47 and columns 80 to 95
    x, y, z = rays[0, 2 * 8 + 5]
    assert (x / z).item() == pytest.approx((87.5 - 63.5) / 100)
    assert (y / z).item() == pytest.approx((39.5 - 47.5) / 90)
