"""Images of an import are those that their poses mean, against Pillow; black and white are the same for all."""

import io
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from captures import capture_of, line, poses_at
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from mambaloc.data.cache import cached_frames
from mambaloc.data.frames import BadFrames, Frames
from mambaloc.errors import InputError
from mambaloc.importing.capture import Camera, Capture
from mambaloc.importing.checks.sanity import check_pixels
from mambaloc.importing.undistort.decoding import counts_of, decoding_of
from mambaloc.importing.undistort.images import write_images
from mambaloc.mapping.posed import with_cameras

KINDS = {"png": "PNG", "jpg": "JPEG", "webp": "WEBP", "jpeg": "JPEG"}


def tagged(folder: Path, name: str, size: tuple[int, int], tag: int, seed: int = 0) -> Path:
    """An image of coarse noise, which JPEG keeps, with an orientation."""
    coarse = np.random.default_rng(seed).integers(0, 256, (4, 4, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = tag
    options = {"quality": 95} if name.endswith(("jpg", "jpeg")) else {"lossless": True} if name.endswith("webp") else {}
    path = folder / name
    Image.fromarray(coarse).resize(size).save(path, KINDS[path.suffix[1:]], exif=exif, **options)
    return path


def captured(kind: str, images: list[Path], camera: tuple[int, int] | None) -> Capture:
    capture = replace(capture_of(poses_at(line(len(images)))), kind=kind, images=tuple(images))
    if camera is None:
        return capture
    width, height = camera
    lens = Camera(width, height, (30.0, 30.0), ((width - 1) / 2, (height - 1) / 2))
    return replace(capture, cameras={"one": lens}, camera_of=("one",) * len(images))


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.integers(1, 8), st.sampled_from(sorted(KINDS))), min_size=1, max_size=5),
    st.sampled_from([(24, 24), (32, 24), (24, 32)]),
    st.sampled_from(["colmap", "nerfstudio", "csv"]),
    st.sampled_from(["stored", "upright", None]),
)
def test_any_orientation_in_any_format(tags, size, kind, shaped_as):
    """Poses mean stored pixels, unless cameras are shaped as the upright images alone are."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        images = [tagged(folder, f"{row}.{suffix}", size, tag, row) for row, (tag, suffix) in enumerate(tags)]
        camera = {"stored": size, "upright": size[::-1], None: None}[shaped_as]
        written = write_images(captured(kind, images, camera), folder / "out")
        if size[0] != size[1] and shaped_as == "upright":  # which those with a tag of 1 to 4 are not
            images = [image for image, (tag, _) in zip(images, tags, strict=True) if tag >= 5]
            expected = [ImageOps.exif_transpose(Image.open(image)) for image in images]
        else:
            expected = [Image.open(image) for image in images]
        assert len(written.capture.images) == len(images)
        for copy, picture in zip(written.capture.images, expected, strict=True):
            with Image.open(copy) as found:
                assert found.getexif().get(0x0112, 1) == 1
                assert found.size == picture.size
                assert np.abs(np.asarray(found).astype(int) - np.asarray(picture)).mean() < 5
        concern = check_pixels(written.decoding).concern
        was_upright = size[0] != size[1] and shaped_as == "upright" and bool(images)
        has_tag = any(tag != 1 for tag, _ in tags)
        assert bool(concern) == (has_tag and kind == "csv" and not was_upright)


def test_one_picture_that_lies_says_what_the_others_mean(tmp_path):
    """A camera as tall as an upright image: poses mean upright pixels, those of a square image, too."""
    images = [tagged(tmp_path, "lying.jpg", (32, 24), 6), tagged(tmp_path, "square.jpg", (24, 24), 3)]
    capture = captured("nerfstudio", images, (24, 32))
    lens = Camera(24, 24, (30.0, 30.0), (11.5, 11.5))
    capture = replace(capture, cameras={**capture.cameras, "two": lens}, camera_of=("one", "two"))
    assert decoding_of(capture).upright
    written = write_images(capture, tmp_path / "out")
    expected = np.asarray(Image.open(images[1]))[::-1, ::-1].astype(int)
    assert np.abs(np.asarray(Image.open(written.capture.images[1])).astype(int) - expected).mean() < 5
    said = "upright, as the cameras' sizes say: 2 of 2 images (such as lying.jpg) were turned"
    assert written.capture.choices["pixels"] == said


def test_pictures_that_were_decided_differently_are_counted_apart(tmp_path):
    """Two phones in one table: the camera of one is shaped as its stored images, that of the other is not."""
    images = [tagged(tmp_path, f"{row}.jpg", (32, 24), tag, row) for row, tag in enumerate([6, 8, 1, 6])]
    capture = captured("csv", images, (32, 24))
    tall = Camera(24, 32, (30.0, 30.0), (11.5, 15.5))
    capture = replace(capture, cameras={**capture.cameras, "tall": tall}, camera_of=("one", "tall", "one", "tall"))
    written = write_images(capture, tmp_path / "out")
    assert [Image.open(image).size for image in written.capture.images] == [(32, 24), (24, 32), (32, 24), (24, 32)]
    said = written.capture.choices["pixels"]
    assert "2 of 4 images (such as 1.jpg) were turned" in said
    assert "1 of 4 images (such as 0.jpg) have an EXIF orientation, dropped" in said
    assert check_pixels(written.decoding).concern.startswith("1 images have an EXIF orientation")


def test_a_training_and_a_map_refuse_a_picture_that_may_be_either_way_round(tmp_path):
    images = [tagged(tmp_path, "a.jpg", (32, 24), 1), tagged(tmp_path, "b.jpg", (32, 24), 3)]
    with pytest.raises(InputError, match=r"b\.jpg: image has EXIF orientation 3"):
        cached_frames(images, 24, BadFrames(), tmp_path / "cache")
    frames = Frames(tuple(images), ("one", "one"), np.zeros((2, 3)), np.eye(4)[[0, 0]])
    with pytest.raises(InputError, match=r"b\.jpg: image has EXIF orientation 3"):
        with_cameras("7scenes", tmp_path, frames)


def deep(folder: Path, row: int, low: int, high: int, strays: int = 0) -> Path:
    """A 16-bit PNG with as many counts of 0 and of 65535 as strays."""
    counts = np.random.default_rng(row).integers(low, high, (50, 80), dtype=np.uint16)
    counts.ravel()[:strays], counts.ravel()[strays : 2 * strays] = 0, 65535
    Image.fromarray(counts).save(folder / f"{row}.png")
    return folder / f"{row}.png"


@given(st.integers(0, 60000), st.integers(20, 5000))
@settings(max_examples=20)
def test_a_few_strays_do_not_move_black_and_white(low, extent):
    with TemporaryDirectory() as folder:
        images = [deep(Path(folder), row, low, low + extent, strays=1) for row in range(4)]
        black, white = counts_of(images)
        assert low <= black < low + 0.01 * extent + 1
        assert low + 0.99 * extent - 2 < white < low + extent


def test_other_pictures_have_no_counts(tmp_path):
    tagged(tmp_path, "a.png", (8, 8), 1)
    (tmp_path / "b.png").write_bytes(io.BytesIO().getvalue())
    assert counts_of([tmp_path / "a.png", tmp_path / "b.png", tmp_path / "c.png"]) is None
    assert counts_of([deep(tmp_path, 0, 0, 65535)]) == (0, 65535)
