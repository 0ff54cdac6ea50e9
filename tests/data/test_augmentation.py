"""Crop and colour jitter: against torchvision, and drawn from (seed, epoch, index) alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from mambaloc.data.augmentation import Jitter, RandomCrop, center_crop, color_matrices, draw_uniforms
from mambaloc.types import PoseBatch

SIZE, CROP = (24, 32), (16, 20)


def images(count: int, low: int = 0, high: int = 256, size: tuple[int, int] = SIZE) -> Tensor:
    return torch.randint(low, high, (count, 3, *size), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)


def smooth_images(count: int) -> Tensor:
    """Gradients of colour between 90 and 160, as photos are: neighbours are alike, and nothing clips."""
    rows, columns = torch.meshgrid(torch.linspace(0, 1, SIZE[0]), torch.linspace(0, 1, SIZE[1]), indexing="ij")
    weights = torch.rand(count, 3, 2, generator=torch.Generator().manual_seed(2))[..., None, None]
    return (90 + 35 * (weights[:, :, 0] * rows + weights[:, :, 1] * columns)).round().to(torch.uint8)


def indices(*rows: int) -> Tensor:
    return torch.tensor(rows)


@dataclass(frozen=True)
class Drawn:
    """What an epoch does to some of its frames: each crop's corner (B,), each colour matrix (B, 3, 4)."""

    top: Tensor
    left: Tensor
    color: Tensor
    crop: RandomCrop
    uniform: Tensor


def drawn(image: Tensor, crop: tuple[int, int], jitter: Jitter, seed: int, epoch: int, rows: Tensor) -> Drawn:
    uniform, view = draw_uniforms(seed, epoch, int(rows.max()) + 1, draws=5)[rows], RandomCrop(crop)
    return Drawn(*view.corners(image, uniform[:, :2]), jitter.matrices(image, uniform[:, 2:]), view, uniform[:, :2])


def augment(image: Tensor, how: Drawn) -> Tensor:
    batch = PoseBatch(image, torch.zeros(len(image), 3), torch.zeros(len(image), 4), torch.arange(len(image)))
    return how.crop(batch, how.color, how.uniform).image


def factors_of(how: Drawn, gray: float) -> np.ndarray:
    """Solve brightness, contrast and saturation from the matrices drawn for images of one gray; (B, 3)."""
    color = how.color.double().numpy()
    both = color[:, 0, :3].sum(-1)  # rows of the saturation's part sum to one
    saturation = (color[:, 0, 0] - color[:, 1, 0]) / both
    brightness = (color[:, 0, 3] + both * gray) / gray
    return np.stack([brightness, both / brightness, saturation], axis=1)


@pytest.mark.parametrize("factors", [(0.8, 1.2, 1.3), (1.2, 0.7, 0.5), (1.0, 1.0, 0.0), (1.1, 0.0, 1.0), (1, 1, 1)])
def test_color_matrix_is_torchvisions_three_adjustments(factors):
    F = pytest.importorskip("torchvision.transforms.v2.functional")
    image = images(1, 90, 160)[0]
    expected = F.adjust_brightness(image.double() / 255, factors[0])
    expected = F.adjust_contrast(expected, factors[1])
    expected = F.adjust_saturation(expected, factors[2])
    assert expected.min() > 0
    assert expected.max() < 1
    luma_mean = F.rgb_to_grayscale(image.double() / 255).mean().item()
    matrix = color_matrices(*(torch.tensor([value]).double() for value in (*factors, luma_mean)))[0]
    actual = torch.einsum("rc,chw->rhw", matrix[:, :3], image.double() / 255) + matrix[:, 3, None, None]
    assert (actual - expected).abs().max() < 1e-3  # torchvision's red weighs 0.2989, ours 0.299


def test_drawn_colors_are_torchvisions_on_the_whole_image():
    """As drawn and applied. The contrast's mean is of every fourth pixel, before the crop."""
    F = pytest.importorskip("torchvision.transforms.v2.functional")
    batch, rows = smooth_images(16), torch.arange(16)
    gray = torch.full_like(batch, 128)
    factors = factors_of(drawn(gray, CROP, Jitter(), 3, 4, rows), 128 / 255)
    how = drawn(batch, CROP, Jitter(), 3, 4, rows)
    out = augment(batch, how)
    for row, (brightness, contrast, saturation) in enumerate(factors.tolist()):
        expected = F.adjust_brightness(batch[row].float() / 255, brightness)
        expected = F.adjust_saturation(F.adjust_contrast(expected, contrast), saturation)
        assert expected.min() > 0
        assert expected.max() < 1
        top, left = how.top[row].item(), how.left[row].item()
        expected = expected[:, top : top + CROP[0], left : left + CROP[1]]
        assert (out[row] - expected).abs().max() <= 2 / 255


def test_crop_is_a_slice():
    batch, rows = images(12), torch.arange(12)
    how = drawn(batch, CROP, Jitter(0, 0, 0), 0, 0, rows)
    out = augment(batch, how)
    assert out.shape == (12, 3, *CROP)
    assert out.dtype == torch.float32
    assert len({(t, s) for t, s in zip(how.top.tolist(), how.left.tolist(), strict=True)}) > 6
    for row in range(12):
        top, left = how.top[row], how.left[row]
        expected = batch[row].numpy()[:, top : top + CROP[0], left : left + CROP[1]] / 255
        np.testing.assert_allclose(out[row].numpy(), expected, atol=1e-6)


def test_every_place_of_the_crop_is_drawn_and_none_beyond():
    batch = images(1).expand(600, -1, -1, -1)
    how = drawn(batch, (22, 29), Jitter(), 0, 0, torch.arange(600))
    corners = set(zip(how.top.tolist(), how.left.tolist(), strict=True))
    assert corners == {(top, left) for top in range(3) for left in range(4)}


def test_a_crop_of_the_whole_image_stays_where_it_is():
    batch = images(3)
    how = drawn(batch, SIZE, Jitter(0, 0, 0), 0, 0, torch.arange(3))
    np.testing.assert_allclose(augment(batch, how).numpy(), batch.numpy() / 255, atol=1e-6)


def test_drawing_depends_on_seed_epoch_and_index_alone():
    batch = images(4)
    whole = drawn(batch, CROP, Jitter(), 1, 2, indices(7, 3, 100, 8))
    torch.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002 -- the global state is what must not matter
    for order in ([0, 1, 2, 3], [2], [3, 1], [1, 0, 3, 2]):
        part = drawn(batch[order], CROP, Jitter(), 1, 2, indices(7, 3, 100, 8)[order])
        assert torch.equal(part.top, whole.top[order])
        assert torch.equal(part.left, whole.left[order])
        assert torch.equal(part.color, whole.color[order])


@pytest.mark.parametrize("other", [(2, 2, 7), (1, 3, 7), (1, 2, 8), (2, 1, 7)])
def test_another_seed_epoch_or_index_draws_otherwise(other):
    batch = images(1)
    first = drawn(batch, CROP, Jitter(), 1, 2, indices(7))
    second = drawn(batch, CROP, Jitter(), other[0], other[1], indices(other[2]))
    assert not torch.allclose(first.color, second.color)


def test_an_epochs_chances_do_not_depend_on_how_many_frames_there_are():
    assert torch.equal(draw_uniforms(1, 2, 100, 5)[:7], draw_uniforms(1, 2, 7, 5))


def test_the_largest_chance_still_crops_inside():
    batch, uniform = images(1), torch.full((1, 2), 1 - 2**-24)
    for crop in ((1, 1), (16, 20), (23, 31), SIZE):
        top, left = RandomCrop(crop).corners(batch, uniform)
        assert (top.item(), left.item()) == (SIZE[0] - crop[0], SIZE[1] - crop[1])


@pytest.mark.parametrize("jitter", [Jitter(), Jitter(0.1, 0.4, 0.0), Jitter(0.0, 0.2, 0.5)])
def test_factors_fill_their_ranges(jitter):
    gray = torch.full((500, 3, 8, 8), 100, dtype=torch.uint8)
    how = drawn(gray, (8, 8), jitter, 0, 0, torch.arange(500))
    spread = np.array([jitter.brightness, jitter.contrast, jitter.saturation])
    factors = factors_of(how, 100 / 255)
    assert (np.abs(factors - 1) <= spread + 1e-5).all()
    np.testing.assert_allclose(factors.min(0), 1 - spread, atol=0.02)
    np.testing.assert_allclose(factors.max(0), 1 + spread, atol=0.02)
    np.testing.assert_allclose(factors.mean(0), 1, atol=0.05)
    varying = factors[:, spread > 0]
    correlation = np.corrcoef(varying.T) - np.eye(varying.shape[1])
    assert np.abs(correlation).max() < 0.2  # drawn each for itself


def test_an_image_is_never_mirrored():
    batch = torch.zeros(300, 3, *SIZE, dtype=torch.uint8)
    batch[..., 12:, :] += 60  # lower half
    batch[..., 16:] += 120  # right half
    out = augment(batch, drawn(batch, CROP, Jitter(), 0, 0, torch.arange(300))).mean(1)
    assert (out[:, 0, -1] > out[:, 0, 0]).all()
    assert (out[:, -1, 0] > out[:, 0, 0]).all()


@pytest.mark.parametrize(("low", "high"), [(0, 1), (255, 256), (0, 256)])
def test_values_stay_in_0_to_1(low, high):
    batch = images(32, low, high)
    out = augment(batch, drawn(batch, CROP, Jitter(1.0, 1.0, 1.0), 0, 0, torch.arange(32)))
    assert out.min() >= 0
    assert out.max() <= 1


@pytest.mark.parametrize("size", [(24, 32), (25, 31), (16, 20)])
@pytest.mark.parametrize("crop", [(16, 20), (15, 15), (1, 2)])
def test_center_crop_is_the_middle(size, crop):
    rows = torch.arange(size[0], dtype=torch.uint8)[:, None].expand(size)
    columns = torch.arange(size[1], dtype=torch.uint8)[None].expand(size)
    out = center_crop(torch.stack([rows, columns, rows])[None].repeat(2, 1, 1, 1), crop)
    assert out.shape == (2, 3, *crop)
    assert out.dtype == torch.float32
    row, column = (out[1, :2] * 255).round().long()
    for place, side, length in ((row[:, 0], size[0], crop[0]), (column[0], size[1], crop[1])):
        assert place.tolist() == list(range(place[0], place[0] + length))
        assert abs(place[0] - (side - 1 - place[-1])) <= 1  # as much before as after
    assert (row == row[:, :1]).all()
    assert (column == column[:1]).all()
    torch.testing.assert_close(out[0], out[1])
