"""Sets of views: the same again, resumed, and refused where the depth supports none."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from mambaloc.errors import InputError
from mambaloc.synthesis import Spread, make_views, views
from mambaloc.synthesis.views import MAX_HOLES

SIZE = (36, 48)


@pytest.fixture(scope="module")
def camera(walk):
    half = np.diag((0.5, 0.5, 1.0))
    half[:2, 2] = -0.25
    return half @ walk.intrinsics[0]


@pytest.fixture(scope="module")
def small_parts():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(views, "PART", 8)
        yield


def made(walk, camera, root, count=20, **options):
    return make_views(walk, walk.world_from_cam, camera, SIZE, count, root, **options)


@pytest.fixture(scope="module")
def twenty(walk, camera, small_parts, tmp_path_factory):
    return made(walk, camera, tmp_path_factory.mktemp("views"))


def test_views_are_arrays_on_disk_in_the_promised_form(twenty, camera):
    shapes = {name: (getattr(twenty, name).shape, str(getattr(twenty, name).dtype)) for name in views._FIELDS}
    assert shapes == {
        "images": ((20, 3, 36, 48), "uint8"),
        "depth_m": ((20, 36, 48), "float16"),
        "intrinsics": ((20, 3, 3), "float64"),
        "world_from_cam": ((20, 4, 4), "float64"),
    }
    assert all(isinstance(getattr(twenty, name), np.memmap) for name in shapes)
    np.testing.assert_array_equal(twenty.intrinsics, np.repeat(camera[None], 20, axis=0))


def test_views_show_what_the_renderer_sees_there(twenty, shoot_room):
    ratio = twenty.depth_m / shoot_room(twenty.world_from_cam).depth_m[:, ::2, ::2]  # pixels half a fine one apart
    assert np.median(np.abs(ratio[np.isfinite(ratio)] - 1)) < 0.02
    assert np.isnan(twenty.depth_m).mean(axis=(1, 2)).max() <= MAX_HOLES


def test_interrupted_making_goes_on_and_ends_the_same(twenty, walk, camera, tmp_path, monkeypatch):
    whole = views._write
    written = []

    def write(folder, part):
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(folder.name)
        whole(folder, part)

    monkeypatch.setattr(views, "_write", write)
    with pytest.raises(KeyboardInterrupt):
        made(walk, camera, tmp_path)
    monkeypatch.setattr(views, "_write", lambda folder, part: (written.append(folder.name), whole(folder, part)))
    resumed = made(walk, camera, tmp_path)
    assert written == ["part-0000", "part-0001", "part-0002"]
    for name in views._FIELDS:
        np.testing.assert_array_equal(getattr(resumed, name), getattr(twenty, name))
    monkeypatch.setattr(views, "_accepted", None)
    np.testing.assert_array_equal(made(walk, camera, tmp_path).images, twenty.images)  # opened, not made
    assert [each.name for each in next(tmp_path.iterdir()).iterdir()] == ["views-20"]


@pytest.mark.parametrize("threads", [1, 3])
def test_views_do_not_depend_on_the_number_of_threads(twenty, walk, camera, tmp_path, threads):
    usual = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        several = made(walk, camera, tmp_path)
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(usual)
    for name in views._FIELDS:
        np.testing.assert_array_equal(getattr(several, name), getattr(twenty, name))


def test_other_seed_and_other_frames_make_other_views(twenty, walk, camera, small_parts, tmp_path):
    other = made(walk, camera, tmp_path, count=8, seed=1)
    assert not np.array_equal(other.world_from_cam, twenty.world_from_cam[:8])
    made(replace(walk, images=255 - walk.images), camera, tmp_path, count=8, seed=1)
    assert len(list(tmp_path.iterdir())) == 2
    shutil.rmtree(tmp_path)


def test_depth_that_supports_no_view_is_refused(walk, camera, small_parts, tmp_path):
    scarce = replace(walk, depth_m=np.where(np.arange(96) < 90, np.nan, walk.depth_m).astype(np.float32))
    with pytest.raises(InputError, match=r"supports 0 of .* views. Give depth to more frames, or do without views"):
        made(scarce.select(np.arange(3)), camera, tmp_path)
    assert not [each for folder in tmp_path.iterdir() for each in folder.iterdir()]


def test_views_stay_clear_of_surfaces(walk, camera, small_parts, tmp_path):
    far = made(walk, camera, tmp_path, count=16, spread=Spread(noise=0.5, noise_deg=20.0))
    near = far.depth_m < 0.1 * walk.median_depth_m
    assert near.mean(axis=(1, 2)).max() <= 0.02
    assert np.linalg.norm(far.world_from_cam[:, :3, 3] - walk.world_from_cam[:, :3, 3].mean(axis=0), axis=1).max() < 4
