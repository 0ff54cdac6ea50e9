"""Views beside training frames: made from the depth of these alone, mixed into batches, and left out where bad."""

from __future__ import annotations

import json
import re
import shutil
import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mambaloc.data import PoseDataModule
from mambaloc.data.datasets.capture import COLUMNS
from mambaloc.data.views import MixedSampler
from mambaloc.errors import InputError, InputWarning
from mambaloc.rendering import embedded_room, embedded_walk, frames_of_sequences, render
from mambaloc.rendering.scenes.layouts import write_7scenes
from mambaloc.synthesis import Views, gate
from mambaloc.synthesis import views as making_views

SIZE, SHORT_SIDE, CROP = (96, 72), 48, (40, 56)
TRAIN, VAL, TEST = 40, 12, 8


@pytest.fixture(scope="module")
def room():
    return embedded_room()


@pytest.fixture(scope="session")
def room_with_depth(shared_folder):
    """A root with one scene, the embedded room: 40 training, 12 validation, 8 test frames, every other with depth."""

    def write(root):
        walks = {n: embedded_walk(count, n, 0.0, 360 / count) for n, count in ((1, TRAIN), (2, VAL), (3, TEST))}
        shots = frames_of_sequences(walks, {3})
        write_7scenes(root, "room", shots, room=embedded_room(), size=SIZE, depth=True, depth_every=2)

    return shared_folder("room_with_depth", write)


@pytest.fixture(scope="session")
def view_cache(shared_folder):
    """A cache of the session, so that a set of views is made once."""
    return shared_folder("view_cache", lambda folder: None)


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch):
    monkeypatch.setattr(making_views, "PART", 8)


@pytest.fixture
def make(room_with_depth, view_cache):
    def module(root=room_with_depth, **options) -> PoseDataModule:
        options = {
            "image_size": CROP, "short_side": SHORT_SIDE, "batch_size": 8, "validation": "sequences",
            "val_sequences": ["seq-02"], "views": 24, "cache_dir": str(view_cache), **options,
        }  # fmt: skip
        data = PoseDataModule("7scenes", str(root), "room", **options)
        data.setup("fit")
        return data

    return module


def copied(root, tmp_path):
    """A copy of the scene whose files a test may change."""
    shutil.copytree(root, tmp_path / "copy")
    return tmp_path / "copy"


def depth_files(root, sequence=1):
    return sorted((root / "room" / f"seq-{sequence:02d}").glob("*.depth.png"))


def lines_of(make, **options) -> tuple[PoseDataModule, list[str]]:
    """A module whose training batches are ready, and what the user was told."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default", InputWarning)
        data = make(**options)
        data.train_dataloader()
    return data, [str(each.message) for each in caught if issubclass(each.category, InputWarning)]


def rows_of(loader) -> list[list[int]]:
    return [batch.index.tolist() for batch in loader]


# --- batches ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("options", "real"), [({}, 2), ({"view_share": 0.5}, 4), ({"view_share": 0.9}, 1)])
def test_batches_mix_frames_and_views_and_an_epoch_is_a_pass_over_frames(make, options, real):
    data = make(**options)
    batches = rows_of(data.train_dataloader())
    assert all(sum(row < TRAIN for row in batch) == real for batch in batches)
    assert all(len(batch) == 8 for batch in batches)
    rows = [row for batch in batches for row in batch]
    assert sorted(row for row in rows if row < TRAIN) == [*range(TRAIN)]
    assert max(rows) == TRAIN + 24 - 1
    described = data.describe()["views"]
    assert {name: described[name] for name in ("count", "depth", "depth_frames")} == {
        "count": 24, "depth": "sensor", "depth_frames": TRAIN // 2,
    }  # fmt: skip
    assert described["share"] == options.get("view_share", 0.75)
    assert described["correlation"] > 0.6


def test_last_batch_is_filled_up_with_views(make):
    batches = rows_of(make(keep_count=39, batch_size=8, view_share=0.5).train_dataloader())
    assert [sum(row < 39 for row in batch) for batch in batches] == [4] * 9 + [3]
    assert [len(batch) for batch in batches] == [8] * 10


def test_order_depends_on_seed_and_epoch_alone_and_uses_views_alike(make, monkeypatch):
    monkeypatch.setenv("PL_GLOBAL_SEED", "5")
    loader = make().train_dataloader()
    epochs = []
    for epoch in range(4):
        loader.sampler.set_epoch(epoch)
        epochs.append(rows_of(loader))
    again = make().train_dataloader()  # as a resumed training has it
    again.sampler.set_epoch(2)
    assert rows_of(again) == epochs[2]
    assert len({str(epoch) for epoch in epochs}) == 4
    counts = Counter(row for epoch in epochs for batch in epoch for row in batch)
    assert {counts[row] for row in range(TRAIN)} == {4}
    assert {counts[row] for row in range(TRAIN, TRAIN + 24)} == {4 * 20 * 6 // 24}


def test_devices_share_frames_and_views(make):
    data = make(view_share=0.5, batch_size=4)
    data.train_dataloader()
    views = Counter()
    for epoch in range(3):
        rows = []
        for rank in range(2):
            sampler = MixedSampler(data.scene.items("train"), 4, 2, rank, seed=0)
            sampler.set_epoch(epoch)
            assert len([*sampler]) == len(sampler) == 40
            rows += sampler
        assert sorted(row for row in rows if row < TRAIN) == [*range(TRAIN)]
        views.update(row for row in rows if row >= TRAIN)
    assert views == dict.fromkeys(range(TRAIN, TRAIN + 24), 3 * 40 // 24)


def test_resident_and_loaded_by_workers_batches_are_the_same(make):
    loaders = [
        make(points_per_frame=16, **how).train_dataloader() for how in ({}, {"resident": True}, {"num_workers": 2})
    ]
    for batches in zip(*loaders, strict=True):
        for name in ("image", "position_m", "quaternion", "index", "points_m", "intrinsics", "holes"):
            first, *others = (getattr(batch, name) for batch in batches)
            for other in others:
                torch.testing.assert_close(other, first, rtol=0, atol=0, equal_nan=True)


def test_views_are_augmented_as_frames_are(make):
    data = make(augmentation="rotation")
    batch = next(iter(data.train_dataloader()))
    out = data.augmented(batch, 3)
    assert out.image.shape == (8, 3, *CROP)
    both = (Rotation.from_quat(each.quaternion.double().numpy(), scalar_first=True) for each in (batch, out))
    before, after = both
    turns_deg = np.degrees(np.abs((before.inv() * after).as_rotvec()))
    assert (turns_deg.max(axis=1) > 0.5).all()
    assert turns_deg.max() <= 10.001


# --- what views are --------------------------------------------------------------------------------------------------


def test_views_show_what_the_renderer_shows_there(make, room):
    data = make()
    data.train_dataloader()
    items = data.scene.items("train")
    batch = items.__getitems__([*range(TRAIN, TRAIN + 24)])
    off = []
    for row in range(24):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(batch.quaternion[row].double().numpy(), scalar_first=True).as_matrix()
        pose[:3, 3] = batch.position_m[row]
        picture, _ = render(room, batch.intrinsics[row].double().numpy(), pose, (64, 48))
        shown = ~batch.holes[row].numpy()
        assert shown.mean() >= 0.5
        off.append(np.abs(batch.image[row].permute(1, 2, 0).numpy().astype(float) - picture)[shown].mean())
    assert np.median(off) < 10
    torch.testing.assert_close(batch.intrinsics, items.intrinsics[:1].expand(24, 3, 3))


@pytest.mark.parametrize("view_depth", ["sensor", "pictures"])
def test_points_lie_on_the_surfaces_that_frames_and_views_show(make, room, view_depth):
    """Of frames with depth and without, held out or not, and of views: OpenCV and the renderer agree on them."""
    data = make(points_per_frame=32, view_depth=view_depth)
    data.train_dataloader()
    batches = [
        data.scene.items("train").__getitems__([0, 1, 18, 33, TRAIN, TRAIN + 9, TRAIN + 23]),
        data.scene.items("val").__getitems__([0, 1, 7]),
    ]
    assert data.describe()["points_source"] == {"train": "views", "val": "views"}
    ratios = []
    for batch in batches:
        for row in range(len(batch.index)):
            seen = batch.points_m[row].double().numpy()
            seen = seen[np.isfinite(seen[:, 0])]
            assert len(seen) >= 24
            rotation = Rotation.from_quat(batch.quaternion[row].double().numpy(), scalar_first=True).as_matrix()
            matrix, position_m = batch.intrinsics[row].double().numpy(), batch.position_m[row].double().numpy()
            shift = -rotation.T @ position_m
            pixels = cv2.projectPoints(seen, cv2.Rodrigues(rotation.T)[0], shift, matrix, None)[0][:, 0]
            assert (np.abs(pixels - (31.5, 23.5)) < (32.5, 24.5)).all()
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, position_m
            depth_m = render(room, matrix, pose, (64, 48))[1]
            x, y = np.rint(pixels).astype(int).clip(0, (63, 47)).T
            ratios.append(np.median(((seen - position_m) @ rotation)[:, 2] / depth_m[y, x]))
    np.testing.assert_allclose(ratios, 1, atol=0.02 if view_depth == "sensor" else 0.05)


def test_nothing_but_training_frames_takes_part(make, room_with_depth, tmp_path, monkeypatch):
    """Views are the same bytes without the depth of held-out, thinned and test frames, which is never opened."""
    root = copied(room_with_depth, tmp_path)
    read = []
    from mambaloc.data.views import depth

    true = depth.read_depth_mm
    monkeypatch.setattr(depth, "read_depth_mm", lambda path: read.append(path) or true(path))
    options = {"root": root, "cache_dir": str(tmp_path / "first"), "keep_every": 2}
    first = make(**options).scene
    first.add_views(torch.device("cpu"))
    chosen = {*depth_files(root)[:TRAIN]}
    assert {*read} == chosen
    assert len(chosen) == TRAIN // 2
    for sequence in (2, 3):
        for file in depth_files(root, sequence):
            file.write_bytes(b"none")
    for image in (root / "room" / "seq-03").glob("*.color.png"):
        image.unlink()
    second = make(**{**options, "cache_dir": str(tmp_path / "second")}).scene
    second.add_views(torch.device("cpu"))
    for name in ("images", "depth_m", "intrinsics", "world_from_cam"):
        np.testing.assert_array_equal(getattr(second.made_views.views, name), getattr(first.made_views.views, name))


def test_thinned_training_reads_depth_of_chosen_frames_alone(make, tmp_path, monkeypatch):
    from mambaloc.data.views import depth

    read, true = [], depth.read_depth_mm
    monkeypatch.setattr(depth, "read_depth_mm", lambda path: read.append(path) or true(path))
    data = make(keep_count=10, cache_dir=str(tmp_path))
    data.scene.add_views(torch.device("cpu"))
    chosen = [path for path in data.frames("train").image_paths if depth.depth_path(path).is_file()]
    assert sorted(read) == sorted(map(depth.depth_path, chosen))
    assert 0 < len(read) <= 10


# --- kept, and made once ---------------------------------------------------------------------------------------------


def test_views_are_made_once_and_opened_after_that(make, tmp_path, monkeypatch):
    from mambaloc.data.views import making

    made = []
    true = making.depth_of_frames
    monkeypatch.setattr(making, "depth_of_frames", lambda *args: made.append(1) or true(*args))
    modules = [make(cache_dir=str(tmp_path)) for _ in range(2)]
    with ThreadPoolExecutor() as pool:  # the second waits
        list(pool.map(lambda data: data.scene.add_views(torch.device("cpu")), modules))
    assert len(made) == 1
    first, second = (data.scene.made_views for data in modules)
    np.testing.assert_array_equal(second.views.images, first.views.images)
    assert second.describe() == first.describe()
    assert first.seconds > 0


# --- bad input -------------------------------------------------------------------------------------------------------


def test_bad_depth_frames_are_named_and_left_out(make, room_with_depth, tmp_path):
    root = copied(room_with_depth, tmp_path)
    files = depth_files(root)
    small, empty, thousandth, truncated = files[3], files[6], files[9], files[12]
    cv2.imwrite(str(small), cv2.imread(str(small), cv2.IMREAD_UNCHANGED)[::2, ::2])
    cv2.imwrite(str(empty), np.zeros((72, 96), np.uint16))
    cv2.imwrite(str(thousandth), np.maximum(cv2.imread(str(thousandth), cv2.IMREAD_UNCHANGED) // 1000, 1))
    truncated.write_bytes(truncated.read_bytes()[:-20])
    data, lines = lines_of(make, root=root, cache_dir=str(tmp_path))
    without = "Views are made without it."
    assert sorted(lines) == sorted(
        [
            f"{small}: depth is not 96x72 as most depth frames are. {without}",
            f"{empty}: depth has no measured pixel. {without}",
            f"{thousandth}: depth is 0.00077 times that of most frames. {without}",
            f"{truncated}: depth is not a complete 16-bit PNG of one channel. {without}",
        ]
    )
    assert data.describe()["views"]["depth_frames"] == TRAIN // 2 - 4
    assert lines_of(make, root=root, cache_dir=str(tmp_path))[1] == lines  # said again where views are only opened


@pytest.mark.parametrize("change", ["thousandth", "thousandfold", "empty", "none", "few"])
def test_depth_that_cannot_be_used_gives_way_to_the_pictures_unless_it_was_asked_for(
    make, room_with_depth, tmp_path, change, monkeypatch
):
    root = copied(room_with_depth, tmp_path)
    for number, file in enumerate(depth_files(root)):
        if change == "thousandth":
            cv2.imwrite(str(file), np.maximum(cv2.imread(str(file), cv2.IMREAD_UNCHANGED) // 1000, 1))
        elif change == "thousandfold":  # which sixteen bits do not hold: poses are in kilometres
            pose_file = str(file).replace(".depth.png", ".pose.txt")
            np.savetxt(pose_file, np.loadtxt(pose_file) * ([[1, 1, 1, 0.001]] * 3 + [[1, 1, 1, 1]]))
        elif change == "empty":
            cv2.imwrite(str(file), np.zeros((72, 96), np.uint16))
        elif change == "none" or number % 2:
            file.unlink()
    disagrees = r"depth.png: depth of this and \d+ more of 20 frames disagrees with the poses. Check the unit"
    expected = {
        "thousandth": disagrees,
        "thousandfold": disagrees,
        "empty": r"depth.png: depth has no measured pixel, and no other depth frame can be used. Repair them, or set",
        "none": "no training frame has depth. Set data.view_depth to pictures",
        "few": "10 of 40 training frames have depth, too few",
    }[change]
    if change != "few":
        with pytest.raises(InputError, match=expected):
            make(root=root, cache_dir=str(tmp_path), view_depth="sensor").train_dataloader()
    from mambaloc.data.views import depth

    monkeypatch.setattr(depth, "depth_from_images", stop_here)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        make(root=root, cache_dir=str(tmp_path)).train_dataloader()
    (line,) = [str(each.message) for each in caught]
    assert re.search(expected, line) or change == "none"
    assert line.endswith("images are searched. The training goes on without views.")


def stop_here(*args, **options):
    raise InputError("images are searched.")


def test_poor_views_are_left_out_and_the_training_goes_on(make, tmp_path, monkeypatch):
    monkeypatch.setattr(gate, "MIN_CORRELATION", 0.99)
    data, lines = lines_of(make, cache_dir=str(tmp_path), points_per_frame=8)
    assert len(lines) == 1
    assert "not worth training on. The training goes on without views." in lines[0]
    described = data.describe()
    assert (described["views"]["count"], described["views"]["share"]) == (0, 0)
    assert described["points_source"] == {"train": "depth", "val": "depth"}  # not from what was found poor
    rows = [row for batch in rows_of(data.train_dataloader()) for row in batch]
    assert sorted(rows) == [*range(TRAIN)]
    assert not [*tmp_path.rglob("views-*")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clip_length": 3}, "data.clip_length 3: clips need sequences, but data.views are single images"),
        ({"views": -1}, "data.views -1: must be 0 or more"),
        ({"view_depth": "lidar"}, "data.view_depth 'lidar': choose one of auto, sensor, pictures"),
        ({"view_share": 1.0}, "data.view_share 1: must be 0 or more and less than 1"),
        ({"batch_size": 1}, "data.batch_size 1: is too small for a frame and a view"),
    ],
)
def test_mistakes_are_told_in_one_line(make, options, message):
    with pytest.raises(InputError) as caught:
        make(**options).train_dataloader()
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_assumed_camera_is_said_once(make, room_with_depth, tmp_path):
    """An imported scene that does not know its camera, whose focal length is 0.9 of the width."""
    root = copied(room_with_depth, tmp_path)
    (root / "room" / "scene.json").write_text(json.dumps({"mambaloc_scene": 1, "unit": "metre"}))
    lines = [",".join(COLUMNS)]
    for image in sorted((root / "room").glob("*/*.color.png")):
        pose = np.loadtxt(str(image).replace(".color.png", ".pose.txt"))
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        numbers = ",".join(f"{number:.9f}" for number in (*pose[:3, 3], w, x, y, z))
        sequence = image.parent.name
        split = {"seq-01": "train", "seq-02": "val", "seq-03": "test"}[sequence]
        lines.append(f"{sequence}/{image.name},{sequence},,{numbers},colour,{split}")
    (root / "room" / "frames.csv").write_text("\n".join(lines))
    options = {"root": root, "cache_dir": str(tmp_path), "validation": "marked", "val_sequences": None}
    data, said = lines_of(make, **options)
    assert len(said) == 1
    assert "has no focal length and centre of camera 'colour'" in said[0]
    assert said[0].endswith("A focal length of 0.87 of the images' longer side is assumed.")
    assert data.describe()["views"]["depth_frames"] == TRAIN // 2


def test_where_views_and_points_cannot_be_had_the_training_goes_on_without_both(make, room_with_depth, tmp_path):
    """Images of grey, without depth: nothing can be searched in them."""
    root = copied(room_with_depth, tmp_path)
    for file in depth_files(root) + depth_files(root, 2):
        file.unlink()
    for image in (root / "room").glob("*/*.color.png"):
        cv2.imwrite(str(image), np.full((SIZE[1], SIZE[0], 3), 128, np.uint8))
    data, said = lines_of(make, root=root, cache_dir=str(tmp_path), points_per_frame=16)
    assert said[0].endswith("The training goes on without views.")
    assert "has no scene points for data.points_per_frame" in said[1]
    assert all(line.endswith("The training goes on without points.") for line in said[1:])
    batch = next(iter(data.train_dataloader()))
    assert batch.points_m is None
    assert len(batch.index) == 8


@pytest.mark.parametrize("resident", [False, True])
def test_other_views_take_the_place_of_some(resident, make):
    data = make(resident=resident, points_per_frame=8)
    loader, new = data.train_dataloader(), data.scene_views.views
    rows = data.view_rows[[3, 0, 23]]
    before = loader.dataset.__getitems__(data.view_rows.tolist())
    data.replace_views(rows, Views(*(getattr(new, field.name)[[7, 8, 9]] for field in fields(Views))))
    after = loader.dataset.__getitems__(data.view_rows.tolist())
    kept = [place for place in range(24) if place not in (3, 0, 23)]
    for name in ("image", "holes", "position_m", "quaternion", "intrinsics", "points_m"):
        torch.testing.assert_close(getattr(after, name)[kept], getattr(before, name)[kept], equal_nan=True)
    np.testing.assert_array_equal(after.image[[3, 0, 23]], new.images[[7, 8, 9]])
    np.testing.assert_array_equal(after.holes[[3, 0, 23]], np.isnan(new.depth_m[[7, 8, 9]]))
    np.testing.assert_allclose(data.poses_of_rows(rows), new.world_from_cam[[7, 8, 9]], atol=1e-6)
