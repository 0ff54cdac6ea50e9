"""Views against images that the renderer takes at the same poses, and surfaces placed by hand."""

import numpy as np
import pytest
import torch

from mambaloc.rendering import default_intrinsics
from mambaloc.synthesis import PosedDepth, PoseSampler, Splatter, Spread
from mambaloc.synthesis.splatting import closed, filled, without_edges

SIZE = (72, 96)


@pytest.fixture(scope="module")
def new_poses(walk):
    sampler = PoseSampler(walk.world_from_cam, walk.median_depth_m, Spread(noise=0.05, noise_deg=5.0))
    return sampler.draw(12, np.random.default_rng(0))


@pytest.fixture(scope="module")
def new_views(walk, new_poses):
    return Splatter(walk).render(new_poses, walk.intrinsics[: len(new_poses)], SIZE)


def off(first, second):
    """Mean difference of colours in each pixel, grey levels."""
    return np.abs(first.astype(float) - second.astype(float)).mean(axis=-3)


def test_view_at_a_new_pose_is_the_picture_that_is_taken_there(new_views, new_poses, shoot_room):
    taken = shoot_room(new_poses)
    is_known = ~new_views.depth_m.isnan().numpy()
    right = np.median(off(new_views.images.numpy(), taken.images)[is_known])
    moved = new_poses.copy()
    moved[:, :3, 3] += 0.05
    wrong = np.median(off(new_views.images.numpy(), shoot_room(moved).images)[is_known])
    assert right < 3
    assert right < wrong / 2
    assert is_known.mean() > 0.8


def test_depth_of_a_view_is_exact(new_views, new_poses, shoot_room):
    ratio = new_views.depth_m.numpy() / shoot_room(new_poses).depth_m
    error = np.abs(ratio[np.isfinite(ratio)] - 1)
    assert np.median(error) < 0.003
    assert np.quantile(error, 0.9) < 0.02


def test_another_camera_sees_the_same_place(walk, shoot_room):
    zoomed = walk.intrinsics[:1].copy()
    zoomed[:, [0, 1], [0, 1]] *= 1.5
    view = Splatter(walk).render(walk.world_from_cam[:1], zoomed, SIZE)
    ratio = zoomed[0] @ np.linalg.inv(default_intrinsics((96, 72)))
    x, y = 30, 40  # a pixel of the frame, where it is in the view
    u, v, _ = np.rint(ratio @ (x, y, 1)).astype(int)
    assert view.depth_m[0, v, u].item() == pytest.approx(float(walk.depth_m[0, y, x]), rel=0.02)


def test_frame_alone_gives_itself(walk):
    only_third = np.arange(len(walk)) == 3
    view = Splatter(walk).render(walk.world_from_cam[[3]], walk.intrinsics[[3]], SIZE, only_third[None])
    is_known = ~view.depth_m[0].isnan().numpy()
    assert is_known.mean() > 0.7  # edges of depth are dropped
    assert off(view.images[0].numpy(), walk.images[3])[is_known].max() <= 1
    np.testing.assert_allclose(view.depth_m[0].numpy()[is_known], walk.depth_m[3][is_known], rtol=1e-4)


def test_without_frames_there_are_only_holes(walk):
    view = Splatter(walk).render(walk.world_from_cam[:1], walk.intrinsics[:1], SIZE, np.zeros((1, len(walk)), bool))
    assert view.hole_share.tolist() == [1.0]


def test_views_do_not_depend_on_those_beside_them(walk, new_poses, new_views):
    single = Splatter(walk).render(new_poses[4:5], walk.intrinsics[:1], SIZE)
    torch.testing.assert_close(single.images[0], new_views.images[4])
    torch.testing.assert_close(single.depth_m[0], new_views.depth_m[4], equal_nan=True, rtol=1e-5, atol=0)


def walls(depths_m, colors, offsets_m):
    """Frames 24x32 that each look straight at one wall, moved sideways."""
    intrinsics = np.array([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]])
    poses = np.tile(np.eye(4), (len(depths_m), 1, 1))
    poses[:, 0, 3] = offsets_m
    images = np.empty((len(depths_m), 3, 24, 32), np.uint8)
    images[:] = np.array(colors)[:, None, None, None]
    depth_m = np.broadcast_to(np.array(depths_m, np.float32)[:, None, None], (len(depths_m), 24, 32)).copy()
    return PosedDepth(images, depth_m, np.repeat(intrinsics[None], len(depths_m), axis=0), poses)


def test_nearer_surface_hides_the_farther_though_a_nearer_frame_sees_that():
    source = walls([3.0, 1.0], [200, 50], [0.0, 0.3])
    source.depth_m[1, :, :16] = np.nan  # the near wall: columns 16 to 31 of the second frame
    view = Splatter(source).render(source.world_from_cam[:1], source.intrinsics[:1], (24, 32))
    # moved by 0.3 m at 1 m: 9 pixels to the right, so that its columns 16 to 22 are seen at 25 to 31
    assert (view.images[0, 0, :, 25:] == 50).all()
    assert (view.images[0, 0, :, :25] == 200).all()
    torch.testing.assert_close(view.depth_m[0, :, 25:], torch.ones(24, 7))
    torch.testing.assert_close(view.depth_m[0, :, :25], torch.full((24, 25), 3.0))


def test_camera_may_stand_before_surfaces_and_not_behind_them():
    source = walls([2.0], [100], [0.0])
    points = np.array([[0, 0, 1.5], [0, 0, 2.5], [0, 0, -1.0], [9.0, 0, 2.5]])
    assert Splatter(source).is_free(points).tolist() == [True, False, True, True]


def test_depth_is_dropped_beside_an_edge_only():
    depth_m = torch.ones(1, 5, 8)
    depth_m[..., 4:] = 1.1
    depth_m[0, 0, 0] = torch.nan  # a pixel without depth is none
    kept = ~without_edges(depth_m)[0].isnan()
    assert kept[:, [1, 2, 5, 6, 7]].all()
    assert kept[1:, 0].all()
    assert not kept[:, 3:5].any()


def test_cracks_are_closed_and_steps_stay():
    depth_m = torch.full((1, 9, 12), 1.0)
    depth_m[..., 7:] = 3.0
    cracked = depth_m.clone()
    cracked[0, :, 3] = 3.0
    cracked[0, 4, 1] = torch.inf
    torch.testing.assert_close(closed(cracked), depth_m)


def test_holes_take_the_colors_around_them():
    images = torch.full((1, 3, 13, 18), 80.0)
    known = torch.ones(1, 1, 13, 18)
    known[..., 2:11, 3:15] = 0
    images[:, :, :2] = 120.0
    images = images * known
    done = filled(images, known)
    assert torch.equal(done * known, images)
    inside = done[..., 2:11, 3:15]
    assert inside.min() >= 80 - 1e-3
    assert inside.max() <= 120 + 1e-3
    assert inside[0, 0, 0].mean() > inside[0, 0, -1].mean()  # the top of the hole is nearer to 120
