"""Views of a turned camera: what the renderer shows from the turned pose, and drawn from (seed, epoch, row) alone."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mambaloc.data import PoseDataModule
from mambaloc.data.augmentation import Jitter, RandomRotation, draw_uniforms
from mambaloc.errors import InputError
from mambaloc.geometry import canonical
from mambaloc.rendering import default_intrinsics, embedded_room, embedded_walk, render
from mambaloc.types import PoseBatch

SIZE, CROP = (288, 384), (224, 320)
COUNT = 4
NO_COLOR = torch.cat((torch.eye(3), torch.zeros(3, 1)), dim=1)


def camera() -> np.ndarray:
    """Its centre is not the image's."""
    matrix = default_intrinsics((SIZE[1], SIZE[0]))
    matrix[:2, 2] += (7, -4)
    return matrix


def batch_of(images: Tensor, world_from_cam: np.ndarray, intrinsics: np.ndarray) -> PoseBatch:
    quaternion = Rotation.from_matrix(world_from_cam[:, :3, :3]).as_quat(canonical=True, scalar_first=True)
    position_m, quaternion = (torch.from_numpy(each).float() for each in (world_from_cam[:, :3, 3], quaternion))
    cameras = torch.from_numpy(intrinsics).float().repeat(len(images), 1, 1)
    return PoseBatch(images, position_m, quaternion, torch.arange(len(images)), intrinsics=cameras)


@pytest.fixture(scope="module")
def room():
    return embedded_room()


@pytest.fixture(scope="module")
def rendered(room) -> tuple[PoseBatch, list[np.ndarray]]:
    """Frames of the embedded room, and the depth of each."""
    walk = np.array(embedded_walk(COUNT, 1, 0.0, 90.0))
    shots = [render(room, camera(), pose, SIZE[::-1], samples=3) for pose in walk]
    images = torch.from_numpy(np.array([rgb for rgb, _ in shots])).permute(0, 3, 1, 2).contiguous()
    return batch_of(images, walk, camera()), [depth_m for _, depth_m in shots]


def pose_of(batch: PoseBatch, row: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(batch.quaternion[row].double().numpy(), scalar_first=True).as_matrix()
    pose[:3, 3] = batch.position_m[row].double().numpy()
    return pose


def turned(batch: PoseBatch, seed: int = 3, rotation_deg: float = 10.0, zoom: float = 0.0) -> PoseBatch:
    view = RandomRotation(CROP, rotation_deg, zoom)
    color = NO_COLOR.repeat(len(batch.image), 1, 1)
    return view(batch, color, draw_uniforms(seed, 0, len(batch.image), view.draws))


@pytest.mark.parametrize("zoom", [0.0, 0.4])
def test_it_is_what_the_renderer_shows_from_the_turned_pose(rendered, room, zoom):
    out = turned(rendered[0], zoom=zoom)
    assert torch.equal(out.position_m, rendered[0].position_m)
    for row in range(COUNT):
        found = out.image[row].permute(1, 2, 0).numpy()
        expected = render(room, out.intrinsics[row].double().numpy(), pose_of(out, row), CROP[::-1], samples=3)[0] / 255
        is_inside = (found > 0).any(axis=-1)
        assert is_inside.mean() > 0.5
        assert np.abs(found - expected)[is_inside].mean() < 0.015  # 0.2 where the turn has the wrong sign
        within = cv2.erode(is_inside.astype(np.uint8), np.ones((5, 5))).astype(bool)
        slopes = np.stack(np.gradient(expected.mean(axis=-1)), axis=-1)[within]
        shift, *_ = np.linalg.lstsq(slopes, (found - expected).mean(axis=-1)[within], rcond=None)
        assert np.abs(shift).max() < 0.02  # pixels


def test_points_lie_where_the_turned_picture_shows_them(rendered):
    """World points of every hundredth pixel: OpenCV projects them by the new pose and camera onto their colour."""
    batch, depths_m = rendered
    out = turned(batch, zoom=0.2)
    for row, depth_m in enumerate(depths_m):
        y, x = (each.ravel() for each in np.mgrid[5 : SIZE[0] : 9, 5 : SIZE[1] : 11])
        rays = np.column_stack((x, y, np.ones(len(x)))) @ np.linalg.inv(camera()).T
        pose = pose_of(batch, row)
        points_m = rays * depth_m[y, x, None] @ pose[:3, :3].T + pose[:3, 3]
        cam_from_world = np.linalg.inv(pose_of(out, row))
        rotation, shift = cv2.Rodrigues(cam_from_world[:3, :3])[0], cam_from_world[:3, 3]
        pixels = cv2.projectPoints(points_m, rotation, shift, out.intrinsics[row].double().numpy(), None)[0][:, 0]
        is_seen = ((pixels > 0) & (pixels < (CROP[1] - 1, CROP[0] - 1))).all(axis=-1)
        assert is_seen.mean() > 0.4
        image = out.image[row].permute(1, 2, 0).numpy()
        shown = cv2.remap(image, *pixels[is_seen].astype(np.float32).T[:, None], cv2.INTER_LINEAR)[0]
        was = batch.image[row][:, y, x].numpy().T[is_seen] / 255
        off = np.abs(shown - was).mean(axis=-1)
        assert np.median(off) < 0.01
        assert (off < 0.1).mean() > 0.93  # the rest are edges, twice interpolated


def rotation_vectors_deg(before: PoseBatch, after: PoseBatch) -> np.ndarray:
    of_both = (Rotation.from_quat(each.quaternion.double().numpy(), scalar_first=True) for each in (before, after))
    cam, new = of_both
    return np.degrees((cam.inv() * new).as_rotvec())


@pytest.mark.parametrize(("rotation_deg", "zoom"), [(10.0, 0.0), (25.0, 0.5)])
def test_turns_and_zooms_fill_their_ranges(rotation_deg, zoom):
    count = 600
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=0).as_matrix()
    batch = batch_of(
        torch.zeros(count, 3, 8, 8, dtype=torch.uint8), poses, np.array([[9.0, 0, 4], [0, 8, 3], [0, 0, 1]])
    )
    view = RandomRotation((6, 4), rotation_deg, zoom)
    out = view(batch, NO_COLOR.repeat(count, 1, 1), draw_uniforms(0, 0, count, view.draws))
    turns = rotation_vectors_deg(batch, out)
    assert np.abs(turns).max() <= rotation_deg + 1e-3
    np.testing.assert_allclose(turns.min(axis=0), -rotation_deg, atol=rotation_deg / 25)
    np.testing.assert_allclose(turns.max(axis=0), rotation_deg, atol=rotation_deg / 25)
    np.testing.assert_allclose(turns.std(axis=0), rotation_deg / np.sqrt(3), rtol=0.07)  # of a uniform distribution
    assert np.abs(np.corrcoef(turns.T) - np.eye(3)).max() < 0.12
    matrices = out.intrinsics.numpy()
    scale = np.log(matrices[:, 0, 0] / 9)
    np.testing.assert_allclose(matrices[:, 1, 1] / 8, np.exp(scale), rtol=1e-5)
    np.testing.assert_allclose(matrices[:, :2, 2], [[4 - 2, 3 - 1]] * count)  # the centre crop's
    np.testing.assert_allclose((scale.min(), scale.max()), (-np.log1p(zoom), np.log1p(zoom)), atol=0.01)
    np.testing.assert_allclose(scale.mean(), 0, atol=0.03)
    assert (out.quaternion[:, 0] >= 0).all()
    torch.testing.assert_close(out.quaternion, canonical(out.quaternion))


def test_black_stays_black_whatever_the_colors(rendered):
    batch = rendered[0]
    view, chances = RandomRotation(CROP, 15.0), draw_uniforms(5, 0, COUNT, 7)
    color = Jitter(0.5, 0.9, 0.5).matrices(batch.image, chances[:, 4:])
    assert (color[:, :, 3].abs() > 0.01).all()  # black would not be
    beyond = view(batch, NO_COLOR.repeat(COUNT, 1, 1) + 1, chances[:, :4]).image == 0
    out = view(batch, color, chances[:, :4]).image
    assert 0.05 < beyond.float().mean() < 0.6
    assert not out[beyond].any()
    assert (out.amin(), out.amax()) == (0, pytest.approx(1, abs=0.2))


# --- in the data module ----------------------------------------------------------------------------------------------


@pytest.fixture
def make(scenes, tmp_path):
    """A scene of two training sequences of 12 frames each."""

    def module(**options) -> PoseDataModule:
        options = {"image_size": (30, 40), "short_side": 36, "augmentation": "rotation", **options}
        data = PoseDataModule(root=str(scenes), scene="heads", validation="none", cache_dir=str(tmp_path), **options)
        data.setup("fit")
        data.trainer = SimpleNamespace(training=True, current_epoch=0, world_size=1, global_rank=0)
        return data

    return module


def fetch(data: PoseDataModule, rows: list[int]) -> PoseBatch:
    return data.scene.parts["train"].data.__getitems__(rows)


TURNED = ("image", "quaternion", "intrinsics")


def test_views_depend_on_seed_epoch_and_row_alone(make, monkeypatch):
    monkeypatch.setenv("PL_GLOBAL_SEED", "5")
    data = make(zoom=0.2)
    whole = data.on_after_batch_transfer(fetch(data, [0, 5, 2, 9]), 0)
    again = make(zoom=0.2, batch_size=3)  # as a resumed training has it
    part = again.on_after_batch_transfer(fetch(again, [9, 5]), 0)
    for name in TURNED:
        torch.testing.assert_close(getattr(part, name), getattr(whole, name)[[3, 1]])
    data.trainer.current_epoch = 1
    later = data.on_after_batch_transfer(fetch(data, [0, 5, 2, 9]), 0)
    monkeypatch.setenv("PL_GLOBAL_SEED", "6")
    other = data.on_after_batch_transfer(fetch(data, [0, 5, 2, 9]), 0)
    for batch in (later, other):
        assert not torch.isclose(batch.quaternion, whole.quaternion).all(dim=1).any()


def test_outside_of_training_nothing_turns(make):
    data = make()
    data.trainer.training = False
    batch = fetch(data, [3, 4])
    out = data.on_after_batch_transfer(batch, 0)
    assert torch.equal(out.quaternion, batch.quaternion)
    assert torch.equal(out.intrinsics[:, :2, :2], batch.intrinsics[:, :2, :2])


def test_frames_of_a_clip_turn_each_on_its_own_and_keep_their_points(make):
    data = make(clip_length=3, clip_skip=1, points_per_frame=5)
    batch = fetch(data, [0, 4])
    out = data.on_after_batch_transfer(batch, 0)
    assert (out.clip_length, len(out.image)) == (3, 6)
    assert out.points_m is batch.points_m
    assert out.position_m is batch.position_m
    turns = rotation_vectors_deg(batch, out)
    assert len(np.unique(turns.round(2), axis=0)) == 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"rotation_deg": value}, "data.rotation_deg") for value in (0.0, -1.0, 45.1, float("nan"))),
        *(({"zoom": value}, "data.zoom") for value in (-0.1, float("nan"), float("inf"))),
        ({"augmentation": "flip"}, "data.augmentation 'flip': choose one of crop, rotation"),
    ],
)
def test_a_mistake_is_one_line(make, options, message):
    with pytest.raises(InputError) as caught:
        make(**options)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)
