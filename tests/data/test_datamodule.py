"""From a scene's folder to batches: each frame in its part, with its image and its pose."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from mambaloc.data.augmentation import Jitter, RandomCrop, draw_uniforms
from mambaloc.data.datamodule import PoseDataModule
from mambaloc.data.datasets import registry as datasets
from mambaloc.errors import InputError
from mambaloc.types import PoseBatch

SEQUENCES = {1: 10, 2: 10, 3: 12, 4: 6}  # ids 0-9, 10-19, 20-31; test: 32-37
SEQ_01, SEQ_02, SEQ_03, TEST = (list(range(*ends)) for ends in ((0, 10), (10, 20), (20, 32), (32, 38)))


@pytest.fixture
def scene(write_tiny_scene):
    return write_tiny_scene(SEQUENCES, test=(4,))


@pytest.fixture
def make(scene, tmp_path) -> Callable[..., PoseDataModule]:
    """Make a data module of the scene, with images of 21 x 16 pixels and crops of 12 x 12."""

    def module(**options) -> PoseDataModule:
        options = {"scene": "den", "image_size": 12, "short_side": 16, "cache_dir": str(tmp_path / "cache"), **options}
        return PoseDataModule(root=str(scene.folder.parent), **options)

    return module


def ids_in(images: Tensor) -> list[int]:
    """The frames that a batch of images shows: each is one colour, whose red is the frame's id."""
    planes = images.flatten(2)
    assert (planes == planes[..., :1]).all()
    assert (planes[:, 1] == 128).all()
    assert (planes[:, 0] + planes[:, 2].int() == 255).all()
    return planes[:, 0, 0].tolist()


def collect(loader) -> tuple[list[int], Tensor]:
    """Read all batches: the frames that the images show, and the batches' ``index``."""
    batches = list(loader)
    return [i for batch in batches for i in ids_in(batch.image)], torch.cat([batch.index for batch in batches])


@pytest.mark.parametrize(
    ("options", "train", "val"),
    [
        ({"validation": "auto", "val_fraction": 0.2}, SEQ_01 + SEQ_02, SEQ_03),
        ({"validation": "sequences", "val_fraction": 0.5}, SEQ_01, SEQ_02 + SEQ_03),
        ({"validation": "sequences", "val_sequences": ["seq-01"]}, SEQ_02 + SEQ_03, SEQ_01),
        (
            {"validation": "block", "val_fraction": 0.2, "val_gap": 3},
            SEQ_01[:5] + SEQ_02[:5] + SEQ_03[:7],
            SEQ_01[8:] + SEQ_02[8:] + SEQ_03[10:],
        ),
        ({"validation": "none"}, SEQ_01 + SEQ_02 + SEQ_03, None),
        ({"validation": "test_set"}, SEQ_01 + SEQ_02 + SEQ_03, TEST),
        ({"validation": "none", "keep_every": 4}, [0, 4, 8, 10, 14, 18, 20, 24, 28], None),
        ({"validation": "none", "keep_count": 4}, [0, 8, 16, 24], None),
        ({"validation": "auto", "keep_every": 5}, [0, 5, 10, 15], SEQ_03),
        ({"validation": "auto", "keep_count": 2}, [0, 10], SEQ_03),
        ({"validation": "test_set", "keep_count": 1}, [0], TEST),
    ],
)
def test_each_part_holds_its_frames_with_their_pictures_and_poses(make, scene, options, train, val):
    module = make(**options, eval_batch_size=5)
    module.setup("fit")
    module.setup("test")
    loaders = {"train": module.train_dataloader(), "val": module.val_dataloader(), "test": module.test_dataloader()}
    for part, ids in (("train", train), ("val", val), ("test", TEST)):
        if ids is None:
            assert loaders[part] == []
            continue
        frames = module.frames(part)
        assert list(frames.image_paths) == [scene.images[i] for i in ids]
        shown, index = collect(loaders[part])
        assert sorted(shown) == ids
        assert shown == [ids[i] for i in index]
        if part != "train":
            assert shown == ids
        position_m = torch.cat([batch.position_m for batch in loaders[part]])
        quaternion = torch.cat([batch.quaternion for batch in loaders[part]])
        if part == "train":  # each reading shuffles alike until the epoch is set
            position_m, quaternion = position_m[index.argsort()], quaternion[index.argsort()]
        assert position_m.dtype == quaternion.dtype == torch.float32
        np.testing.assert_allclose(position_m, scene.position_m(ids), atol=1e-6)
        np.testing.assert_allclose(quaternion, scene.quaternion(ids), atol=1e-6)
    np.testing.assert_allclose(module.train_position_m, scene.position_m(train), atol=1e-6)


def test_batches_have_their_size_and_the_cached_pictures(make):
    module = make(validation="test_set", batch_size=5, eval_batch_size=4)
    module.setup("fit")
    assert [tuple(b.image.shape) for b in module.train_dataloader()] == [(5, 3, 16, 21)] * 6 + [(2, 3, 16, 21)]
    assert [len(b.image) for b in module.test_dataloader()] == [4, 2]
    assert [len(b.image) for b in module.predict_dataloader()] == [4, 2]
    assert next(iter(module.val_dataloader())).image.dtype == torch.uint8


def test_testing_reads_no_training_frame(make, scene):
    for image in scene.images[:32]:
        image.unlink()
    module = make()
    module.setup("test")
    assert collect(module.test_dataloader())[0] == TEST
    assert module.describe()["listed_frames"] == {"test": 6}


def test_fitting_reads_no_test_frame_unless_it_selects_on_it(make, scene):
    for image in scene.images[32:]:
        image.unlink()
    make().setup("fit")
    with pytest.raises(InputError, match="pose without image"):
        make(validation="test_set").setup("fit")


def test_describe_counts_what_was_left_out_and_where(make, scene):
    spoil_pose = scene.folder / "seq-01" / "frame-000003.pose.txt"  # known when reading
    spoil_pose.write_text("1 0 0\n")
    for number in (5, 12):  # known only when decoding: two to train on, one to validate on, one to test on
        scene.images[number].write_bytes(scene.images[number].read_bytes()[:-20])
    scene.images[21].write_bytes(b"")
    scene.images[33].write_bytes(b"text")
    module = make(on_bad_frame="skip", val_fraction=0.2)
    module.setup("fit")
    module.setup("test")
    described = module.describe()
    assert described["skipped"] == {
        "train": {"pose is not a 4x4 matrix but has rows of [3]": 1, "image is truncated": 2},
        "val": {"image cannot be decoded": 1},
        "test": {"image cannot be decoded": 1},
    }
    assert described["listed_frames"] == {"train": 32, "test": 6}
    assert [described[f"{part}_frames"] for part in ("train", "val", "test")] == [17, 11, 5]
    assert described["repaired"] == {"train": 0, "val": 0, "test": 0}
    for part, ids in (
        ("train", [i for i in SEQ_01 + SEQ_02 if i not in (3, 5, 12)]),
        ("val", [i for i in SEQ_03 if i != 21]),
        ("test", [i for i in TEST if i != 33]),
    ):
        loader = getattr(module, f"{part}_dataloader")()
        shown, index = collect(loader)
        assert shown == [ids[i] for i in index]
        assert [module.frames(part).image_paths[i] for i in index] == [scene.images[i] for i in shown]
        for batch in loader:
            np.testing.assert_allclose(batch.position_m, scene.position_m([ids[i] for i in batch.index]), atol=1e-6)


def test_a_bad_image_stops_the_run_by_default(make, scene):
    scene.images[12].write_bytes(b"")
    with pytest.raises(InputError, match=r"seq-02/frame-000002\.color\.png: image cannot be decoded"):
        make().setup("fit")


def test_describe_says_how_the_numbers_were_made(make):
    module = make(validation="test_set", keep_every=2, image_size=(10, 12))
    module.setup("fit")
    described = module.describe()
    assert described["validation"] == "test_set"
    assert (described["keep_every"], described["keep_count"]) == (2, None)
    assert (described["train_frames"], described["val_frames"]) == (16, 6)
    assert (described["image_size"], described["short_side"]) == ([10, 12], 16)
    assert (described["dataset"], described["scene"]) == ("7scenes", "den")
    assert described["official_split"] is False


@pytest.mark.parametrize(("counts", "official"), [((32, 6), True), ((32, 7), False)])
def test_official_split_goes_by_the_listed_frames(make, scene, monkeypatch, counts, official):
    """Thinning and undecodable images do not change what the split files list."""
    monkeypatch.setitem(datasets.DATASETS["7scenes"].official_counts, "den", counts)
    scene.images[1].write_bytes(b"")
    module = make(on_bad_frame="skip", keep_every=3)
    module.setup("fit")
    module.setup("test")
    assert module.describe()["official_split"] is official
    (module.folder / "scene.json").write_text('{"rendered_by": "someone"}')
    assert module.describe()["official_split"] is False
    assert module.describe()["rendered"] is True
    for content in ("half a line", "[" * 100_000, "[]"):
        (module.folder / "scene.json").write_text(content)
        assert module.describe()["rendered"] is False


def order(module: PoseDataModule, epoch: int) -> list[int]:
    loader = module.train_dataloader()
    loader.sampler.set_epoch(epoch)  # as Lightning does
    return collect(loader)[1].tolist()


def test_order_depends_on_seed_and_epoch_alone(make, monkeypatch):
    monkeypatch.setenv("PL_GLOBAL_SEED", "5")
    first, second = make(), make(batch_size=3)
    for module in (first, second):
        module.setup("fit")
    orders = {epoch: order(first, epoch) for epoch in range(3)}
    torch.manual_seed(1234)
    assert {epoch: order(second, epoch) for epoch in range(3)} == orders
    assert order(first, 1) == orders[1]
    assert all(sorted(o) == list(range(20)) for o in orders.values())
    assert len({tuple(o) for o in orders.values()} | {tuple(range(20))}) == 4
    monkeypatch.setenv("PL_GLOBAL_SEED", "6")
    assert order(first, 0) != orders[0]


def test_workers_give_the_same_batches(make):
    batches = []
    for num_workers in (0, 2):
        module = make(num_workers=num_workers, batch_size=6)
        module.setup("fit")
        loader = module.train_dataloader()
        loader.sampler.set_epoch(1)
        batches.append(list(loader))
        del loader  # which stops its workers
    assert len(batches[0]) == len(batches[1]) == 4
    for alone, by_worker in zip(*batches, strict=True):
        for name in ("image", "position_m", "quaternion", "index"):
            assert torch.equal(getattr(alone, name), getattr(by_worker, name))


@pytest.mark.parametrize("clips", [{}, {"clip_length": 3, "clip_skip": 2}])
def test_resident_frames_give_the_same_batches_as_the_memory_map(make, clips):
    batches = []
    for resident in (None, True):
        module = make(resident=resident, num_workers=2, batch_size=6, **clips)
        module.setup("fit")
        loader = module.train_dataloader()
        assert loader.num_workers == (0 if resident else 2)
        batches.append([*loader, *module.val_dataloader()])
    for mapped, in_memory in zip(*batches, strict=True):
        assert mapped.clip_length == in_memory.clip_length
        for name in ("image", "position_m", "quaternion", "index"):
            assert torch.equal(getattr(mapped, name), getattr(in_memory, name))


def gradient_batch() -> PoseBatch:
    image = torch.arange(16 * 21, dtype=torch.uint8).reshape(1, 1, 16, 21).repeat(4, 3, 1, 1)
    return PoseBatch(
        image, torch.zeros(4, 3), torch.zeros(4, 4), torch.arange(4), intrinsics=torch.eye(3).repeat(4, 1, 1)
    )


@pytest.mark.parametrize("trainer", [None, SimpleNamespace(training=False, current_epoch=2)])
@pytest.mark.parametrize(("image_size", "crop"), [(12, (12, 12)), ((10, 20), (10, 20)), (16, (16, 16))])
def test_outside_training_a_batch_is_cropped_in_the_center(make, trainer, image_size, crop):
    module, batch = make(image_size=image_size), gradient_batch()
    module.trainer = trainer
    out = module.on_after_batch_transfer(batch, 0)
    top, left = (16 - crop[0]) // 2, (21 - crop[1]) // 2
    expected = batch.image.numpy()[..., top : top + crop[0], left : left + crop[1]] / 255
    np.testing.assert_allclose(out.image.numpy(), expected, atol=1e-7)
    assert out.image.dtype == torch.float32
    assert out.index is batch.index
    assert batch.image.dtype == torch.uint8  # the batch itself is left as it was


def test_training_batches_are_augmented_by_seed_epoch_and_index(make, monkeypatch):
    monkeypatch.setenv("PL_GLOBAL_SEED", "5")
    module, batch = make(image_size=(12, 14), brightness=0.1, contrast=0.2, saturation=0.4), gradient_batch()
    module.setup("fit")
    module.trainer = SimpleNamespace(training=True, current_epoch=2)
    out = module.on_after_batch_transfer(batch, 0).image
    chances = draw_uniforms(5, 2, 4, draws=5)
    color = Jitter(0.1, 0.2, 0.4).matrices(batch.image, chances[:, 2:])
    assert torch.equal(out, RandomCrop((12, 14))(batch, color, chances[:, :2]).image)
    assert not torch.equal(out[0], out[1])
    module.trainer.current_epoch = 3
    assert not torch.equal(module.on_after_batch_transfer(batch, 0).image, out)


@pytest.mark.parametrize(
    ("image_size", "short_side", "fits"),
    [
        (16, 16, True),
        ((16, 21), 16, True),
        ((12, 20), 16, True),
        (17, 16, False),
        ((20, 12), 16, False),
        ((12, 22), 16, False),
    ],
)
def test_a_crop_larger_than_the_images_is_refused(make, image_size, short_side, fits):
    """The images are landscape: 21 x 16 once resized."""

    def load() -> None:
        make(image_size=image_size, short_side=short_side).setup("fit")

    if fits:
        load()
    else:
        with pytest.raises(InputError, match=r"data\.image_size .*: larger than ") as caught:
            load()
        assert "\n" not in str(caught.value)


def test_a_crop_that_can_fit_no_image_is_refused_before_reading(make):
    with pytest.raises(InputError, match=r"data\.image_size 17: larger than data\.short_side 16"):
        make(image_size=17)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": "heads"}, "mambaloc download 7scenes heads --root"),
        ({"scene": "haeds"}, "Did you mean heads?"),
        ({"dataset": "cambridge", "scene": "ShopFacade"}, "mambaloc download cambridge ShopFacade --root"),
        ({"dataset": "8scenes"}, "data.dataset '8scenes': no such dataset. Did you mean 7scenes?"),
        ({"val_sequences": ["seq-09"]}, "data.val_sequences: no seq-09 in the training split"),
        ({"keep_count": 21}, "data.keep_count 21: there are 20 training frames"),
        ({"keep_every": 0}, "data.keep_every 0: must be 1 or more"),
        ({"validation": "block", "val_gap": 11}, "data.val_fraction 0.1 and val_gap 11 leave 0 frames to train"),
    ],
)
def test_a_mistake_is_told_in_one_line_with_its_remedy(make, options, message):
    with pytest.raises(InputError) as caught:
        make(**options).setup("fit")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_cambridge_scene_is_read_by_its_own_rules(tmp_path):
    folder = tmp_path / "den"
    (folder / "seq1").mkdir(parents=True)
    for number in range(3):
        cv2.imwrite(str(folder / "seq1" / f"{number}.png"), np.full((24, 32, 3), (255 - number, 128, number), np.uint8))
    lines = [f"seq1/{number}.png {number} 0 0 {scale} {scale} 0 0" for number, scale in enumerate((1, 0.70710678, 1e5))]
    for split in ("train", "test"):
        (folder / f"dataset_{split}.txt").write_text("a\nb\n\n" + "\n".join(lines))
    module = PoseDataModule("cambridge", str(tmp_path), "den", 12, 16, validation="none", cache_dir=str(tmp_path / "c"))
    module.setup("fit")
    (batch,) = module.train_dataloader()
    assert ids_in(batch.image) == batch.position_m[:, 0].tolist() == batch.index.tolist()
    half = 0.5**0.5  # a turn by -90 degrees about x: the inverse of what the file holds
    np.testing.assert_allclose(batch.quaternion, [[half, -half, 0, 0]] * 3, atol=1e-6)
    assert module.describe()["repaired"] == {"train": 2}


def test_the_embedded_scene_is_made_where_there_is_none(write_tiny_scene, tmp_path, monkeypatch):
    made: list[Path] = []

    def ensure(root: Path) -> Path:
        made.append(root)
        return write_tiny_scene({1: 4, 2: 2}, test=(2,), name="room").folder

    monkeypatch.setattr("mambaloc.rendering.scenes.embedded.ensure_embedded_scene", ensure)
    assert datasets.scene_folder("embedded", tmp_path / "here", "anything").name == "room"
    assert made == [tmp_path / "here"]
