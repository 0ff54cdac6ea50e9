"""Points and cameras in batches: they follow a coloured spot through resize, crop, skipped frames and splits."""

from __future__ import annotations

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.types import PoseBatch

SIZE, SHORT_SIDE, CROP = (64, 48), 36, (30, 36)
K = np.array([[50.0, 0, 30], [0, 52, 25], [0, 0, 1]])
"""The colour camera's. The depth camera has twice its focal length, and sees the same ray at another pixel."""
DEPTH_K = np.array([[100.0, 0, 33], [0, 104, 22], [0, 0, 1]])
RED, REACH = (0, 0, 255), 3


def spot(number: int) -> tuple[int, int]:
    """Where the frame shows its red square: a pixel that every crop keeps, another in every frame."""
    return 26 + number % 10, 20 + number // 10


@pytest.fixture
def scene(write_tiny_scene):
    """Three training and one test sequence; each frame is black but for a red square, whose middle alone has depth."""
    scene = write_tiny_scene({1: 6, 2: 6, 3: 4, 4: 4}, test=(4,))
    np.savetxt(scene.folder / "camera-intrinsics.txt", DEPTH_K)
    (scene.folder / "scene.json").write_text(json.dumps({"intrinsics_px": K.tolist()}))
    for number, image in enumerate(scene.images):
        x, y = spot(number)
        picture, depth_mm = np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.uint16)
        picture[y - REACH : y + REACH + 1, x - REACH : x + REACH + 1] = RED
        depth_mm[2 * (y - 25) + 22, 2 * (x - 30) + 33] = 1000 + 10 * number
        cv2.imwrite(str(image), picture)
        cv2.imwrite(str(image).replace(".color.", ".depth."), depth_mm)
    return scene


@pytest.fixture
def make(scene, tmp_path):
    def build(**options) -> PoseDataModule:
        quiet = {"brightness": 0.0, "contrast": 0.0, "saturation": 0.0}
        chosen = {"validation": "sequences", "points_per_frame": 2, "batch_size": 5, **quiet, **options}
        root, cache_dir = str(scene.folder.parent), str(tmp_path / "cache")
        return PoseDataModule("7scenes", root, "den", CROP, SHORT_SIDE, cache_dir=cache_dir, **chosen)

    return build


def projected(batch: PoseBatch) -> np.ndarray:
    """Where OpenCV projects each frame's first point, (B, 2), by the batch's own pose and intrinsics."""
    assert batch.points_m is not None
    assert batch.intrinsics is not None
    pixels = []
    for point, camera, q, t in zip(
        batch.points_m[:, 0], batch.intrinsics, batch.quaternion, batch.position_m, strict=True
    ):
        cam_from_world = Rotation.from_quat(np.roll(q.double(), -1)).inv()
        shift = -cam_from_world.apply(t.double())
        at = cv2.projectPoints(point.double().numpy(), cam_from_world.as_rotvec(), shift, camera.double().numpy(), None)
        pixels.append(at[0][0, 0])
    return np.array(pixels)


def red_centers(image: torch.Tensor) -> np.ndarray:
    """The centre of what is red in each image, pixels (B, 2)."""
    red = image[:, 0].double()
    red = red / red.sum((-2, -1), keepdim=True)
    x = (red.sum(-2) * torch.arange(image.shape[-1])).sum(-1)
    return torch.stack([x, (red.sum(-1) * torch.arange(image.shape[-2])).sum(-1)], dim=-1).numpy()


@pytest.mark.parametrize("training", [True, False])
def test_points_project_onto_their_texture_in_every_crop(make, training):
    module = make()
    module.setup("fit")
    module.trainer = SimpleNamespace(
        training=training,
        current_epoch=3,
        world_size=1,
        global_rank=0,
        strategy=SimpleNamespace(root_device=torch.device("cpu")),
        fit_loop=SimpleNamespace(epoch_progress=SimpleNamespace(current=SimpleNamespace(processed=3))),
    )
    shifts = []
    for loader in (module.train_dataloader(), module.val_dataloader()):
        for batch in loader:
            np.testing.assert_allclose(projected(batch), red_centers(batch.image), atol=0.05)
            out = module.on_after_batch_transfer(batch, 0)
            assert out.image.shape[-2:] == CROP
            np.testing.assert_allclose(projected(out), red_centers(out.image), atol=0.05)
            assert out.points_m is batch.points_m
            shifts.append(batch.intrinsics[:, :2, 2] - out.intrinsics[:, :2, 2])
    corners = torch.cat(shifts)
    assert torch.equal(corners, corners.round())
    assert (len(corners.unique(dim=0)) > 5) if training else (corners == torch.tensor([6.0, 3.0])).all()


def test_intrinsics_are_scaled_by_hand(make):
    module = make()
    module.setup("fit")
    (batch,) = module.val_dataloader()
    by_hand = [[37.5, 0, 30.5 * 0.75 - 0.5], [0, 39, 25.5 * 0.75 - 0.5], [0, 0, 1]]
    np.testing.assert_allclose(batch.intrinsics, np.tile(by_hand, (4, 1, 1)), rtol=1e-6)


def test_each_frame_has_its_own_points_also_where_others_are_skipped(make, scene):
    scene.images[2].write_bytes(b"")
    scene.images[9].write_bytes(scene.images[9].read_bytes()[:-20])
    module = make(on_bad_frame="skip", keep_every=2)
    module.setup("fit")
    assert [path.name[6:12] for path in module.frames("train").image_paths] == [
        "000000",
        "000004",
        "000000",
        "000002",
        "000004",
    ]
    for batch in module.train_dataloader():
        np.testing.assert_allclose(projected(batch), red_centers(batch.image), atol=0.05)
        assert batch.points_m.shape[1:] == (2, 3)
        assert batch.points_m[:, 1].isnan().all()  # each frame has depth at one pixel


def test_test_frames_carry_points_only_where_they_are_validated_on(make):
    module = make()
    module.setup("fit")
    module.setup("test")
    (batch,) = module.test_dataloader()
    assert batch.points_m is None
    selecting = make(validation="test_set")
    selecting.setup("fit")
    (validated,) = selecting.val_dataloader()
    np.testing.assert_allclose(projected(validated), red_centers(validated.image), atol=0.05)


def test_by_default_none_are_read(make):
    module = make(points_per_frame=0)
    module.setup("fit")
    (batch,) = module.val_dataloader()
    assert module.on_after_batch_transfer(batch, 0).points_m is None
    assert "points_source" not in module.describe()


def test_every_part_has_its_cameras_with_and_without_points(make):
    by_hand = np.array([[37.5, 0, 30.5 * 0.75 - 0.5 - 6], [0, 39, 25.5 * 0.75 - 0.5 - 3], [0, 0, 1]])
    for count in (0, 2):
        module = make(points_per_frame=count)
        module.setup("fit")
        module.setup("test")
        for part, loader in (("val", module.val_dataloader()), ("test", module.test_dataloader())):
            (fetched,), (batch,) = loader, module.batches(part)
            for found in (batch, module.on_after_batch_transfer(fetched, 0)):
                np.testing.assert_allclose(found.intrinsics, [by_hand] * 4, rtol=1e-6)
                assert found.intrinsics.dtype == torch.float32
        (described,) = {json.dumps(of) for of in module.describe()["cameras"].values()}
        assert json.loads(described) == {"focal_ratio": 0.7812, "assumed": False}


def test_describe_says_how_many_points_and_whence(make):
    module = make()
    module.setup("fit")
    described = module.describe()
    assert described["points_source"] == {"train": "depth", "val": "depth"}
    assert described["points_per_frame"] == {"train": 1.0, "val": 1.0}


def test_workers_carry_the_same_points(make):
    batches = []
    for num_workers in (0, 1):
        module = make(num_workers=num_workers)
        module.setup("fit")
        batches.append(next(iter(module.train_dataloader())))
    assert torch.equal(batches[0].points_m.nan_to_num(), batches[1].points_m.nan_to_num())
    assert torch.equal(batches[0].intrinsics, batches[1].intrinsics)


def test_mistakes_are_told_in_one_line(make, scene):
    with pytest.raises(InputError, match=r"data\.points_per_frame -1: must be 0 or more"):
        make(points_per_frame=-1)
    for depth in scene.folder.rglob("*.depth.png"):
        depth.unlink()
    with pytest.raises(InputError, match=r"no depth frame .* no reconstruction\.nvm, no COLMAP model") as caught:
        make().setup("fit")
    assert "\n" not in str(caught.value)
