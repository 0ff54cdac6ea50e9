"""Features of frozen layers are computed once, kept, and trained on as if they were computed at each step."""

from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from mambaloc.errors import InputError
from mambaloc.models import create_model
from mambaloc.models.feature_cache import FeatureCache

ROWS, DRAWS = 6, 2
EVERYTHING = 2**20


class Counting:
    """Two feature maps of an image; counts the images."""

    def __init__(self):
        self.images = 0

    def __call__(self, image):
        self.images += len(image)
        return [image[:, :2], image.mean(dim=(2, 3), keepdim=True)]


def cache_of(folder, max_bytes=EVERYTHING, key="k"):
    compute = Counting()
    cache = FeatureCache(compute, torch.zeros(1, 3, 4, 5), ROWS, DRAWS, max_bytes, key, folder)
    compute.images = 0
    return cache, compute


def batch_of(*rows, epoch=0):
    index = torch.tensor(rows)
    image = torch.rand(ROWS * DRAWS, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    return SimpleNamespace(index=index, image=image[index + ROWS * (epoch % DRAWS)])


def test_each_image_and_draw_is_computed_once(tmp_path):
    cache, compute = cache_of(tmp_path)
    for epoch in range(4):
        for rows in ((0, 3, 5), (3, 1)):
            batch = batch_of(*rows, epoch=epoch)
            for found, expected in zip(cache(batch, epoch), Counting()(batch.image), strict=True):
                assert_close(found, expected, rtol=1e-3, atol=1e-3)
    assert compute.images == DRAWS * 4  # rows 0, 1, 3 and 5


def test_a_later_process_goes_on_where_another_was_killed(tmp_path):
    first, compute = cache_of(tmp_path)
    expected = first(batch_of(0, 1, 2), 0)
    again, compute = cache_of(tmp_path)
    assert_close(again(batch_of(0, 1, 2), 0), expected, rtol=0, atol=0)
    assert compute.images == 0
    other, compute = cache_of(tmp_path, key="other weights")
    other(batch_of(0, 1, 2), 0)
    assert compute.images == 3


def test_what_finds_no_room_is_computed_each_time(tmp_path):
    bytes_an_image = 2 * (2 * 4 * 5 + 3)
    cache, compute = cache_of(tmp_path, max_bytes=4 * bytes_an_image + 1)
    for _ in range(3):
        batch = batch_of(2, 3, 4, 5)
        assert_close(cache(batch, 0)[0], batch.image[:, :2], rtol=1e-3, atol=1e-3)
    assert compute.images == 4 + 2 + 2
    (file,) = tmp_path.glob("features/*/features.npy")
    assert file.stat().st_size <= 4 * bytes_an_image + 256  # NumPy's header


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "features").write_text("a file")
    with pytest.raises(InputError, match=r"features: cannot be written .* set model\.feature_cache_gib to 0"):
        cache_of(tmp_path)


def test_compiled_steps_keep_no_features():
    with pytest.raises(InputError, match=r"model\.feature_cache_gib: its steps do not run compiled"):
        create_model("mambaloc", compile_mode="default", feature_cache_gib=1.0)


@pytest.mark.parametrize("gib", [-1.0, float("nan"), float("inf")])
def test_a_size_out_of_range(gib):
    with pytest.raises(InputError, match=rf"model\.feature_cache_gib {gib:g}: must be 0 or more"):
        create_model("mambaloc", feature_cache_gib=gib)
