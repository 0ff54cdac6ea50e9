"""Images of every kind against Pillow."""

import io
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from mambaloc.errors import InputError
from mambaloc.exif import orientation_of, turned, turned_back, without_exif
from mambaloc.images import decode_image, is_image, list_images, read_image

TAGS = st.integers(1, 8)
SIDES = st.integers(8, 24)


def noise(width, height, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def encoded(pixels, kind, tag, **options):
    """A file's bytes with an orientation, by Pillow."""
    exif, file = Image.Exif(), io.BytesIO()
    exif[0x010F], exif[0x0112] = "a camera's maker", tag
    Image.fromarray(pixels).save(file, kind, exif=exif, **options)
    return file.getvalue()


@given(SIDES, SIDES, TAGS, st.sampled_from([("PNG", {}), ("WEBP", {"lossless": True}), ("JPEG", {"quality": 95})]))
def test_any_orientation_is_read_as_pillow_reads_it(width, height, tag, kind):
    data = encoded(noise(width, height), kind[0], tag, **kind[1])
    image = Image.open(io.BytesIO(data))
    assert orientation_of(data) == tag
    # Decoders of JPEG differ by rounding; noise leaves no doubt which way round it is.
    within = 12 if kind[0] == "JPEG" else 0
    for expected, upright in ((ImageOps.exif_transpose(image), True), (image, False)):
        found = decode_image(data, upright)
        assert found.shape == np.asarray(expected).shape
        assert np.abs(found.astype(int) - np.asarray(expected)).mean() <= within


@given(SIDES, SIDES, TAGS, st.booleans())
def test_a_tiff_is_turned_only_where_it_should_be(width, height, tag, is_deep):
    """OpenCV turns it even with IMREAD_IGNORE_ORIENTATION."""
    stored = noise(width, height)[..., 0].astype(np.uint16) * 257 if is_deep else noise(width, height)
    file = io.BytesIO()
    Image.fromarray(stored).save(file, "TIFF", tiffinfo={0x0112: tag})
    expected = noise(width, height)[..., :1].repeat(3, axis=-1) if is_deep else stored
    np.testing.assert_array_equal(decode_image(file.getvalue(), upright=False), expected)
    np.testing.assert_array_equal(decode_image(file.getvalue()), turned(expected, tag))


@given(SIDES, SIDES, TAGS)
def test_turning_back_undoes_turning(width, height, tag):
    np.testing.assert_array_equal(turned_back(turned(noise(width, height), tag), tag), noise(width, height))


@given(TAGS, st.booleans())
def test_a_jpeg_loses_its_tag_and_no_pixel(tag, has_xmp):
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description tiff:Orientation="6"/></x:xmpmeta>'
    data = encoded(noise(24, 16), "JPEG", tag, **({"xmp": xmp} if has_xmp else {}))
    bare = Image.open(io.BytesIO(without_exif(data)))
    assert 0x0112 not in bare.getexif()
    np.testing.assert_array_equal(np.asarray(bare), np.asarray(Image.open(io.BytesIO(data))))


@given(st.binary(max_size=60), st.integers(0, 200))
def test_a_damaged_tag_is_none(noise_bytes, cut):
    data = encoded(noise(16, 8), "JPEG", 6)
    for damaged in (data[:cut], data[:20] + noise_bytes + data[20:], noise_bytes, b"II*\0" + noise_bytes):
        assert 1 <= orientation_of(damaged) <= 8
        without_exif(data[:cut])


def test_a_loop_of_chunks_ends():
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4s", 0, b"IDAT") * 1000
    assert orientation_of(png) == 1
    assert orientation_of(b"II*\0" + struct.pack("<IH", 8, 65535)) == 1


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
def test_every_kind_of_png_is_rgb(mode, tmp_path):
    image = Image.fromarray(noise(24, 16)).convert(mode)
    image.save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), np.asarray(image.convert("RGB")))


@pytest.mark.parametrize("mode", ["grey", "colour"])
def test_sixteen_bits_are_read_by_the_counts_that_are_given(mode, tmp_path):
    shape = (16, 24) if mode == "grey" else (16, 24, 3)
    counts = np.random.default_rng(1).integers(1000, 3000, shape, dtype=np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), counts if mode == "grey" else counts[..., ::-1])
    with pytest.raises(InputError, match=r"a\.png: image has 16 bits and only counts from 10\d\d to 2\d\d\d"):
        read_image(tmp_path / "a.png")
    expected = np.clip(np.rint((counts.reshape(16, 24, -1).astype(float) - 1200) * 255 / (2900 - 1200)), 0, 255)
    found = read_image(tmp_path / "a.png", (1200, 2900))
    np.testing.assert_array_equal(found, np.broadcast_to(expected, (16, 24, 3)))


def test_a_photograph_of_sixteen_bits_keeps_its_upper_ones(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), noise(24, 16)[..., ::-1].astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), noise(24, 16))


@pytest.mark.parametrize(
    ("head", "is_still"),
    [
        (b"\0\0\0\x18ftypheic", True),
        (b"\0\0\0\x1cftypmif1", True),
        (b"\0\0\0\x18ftypmp42", False),
        (b"\0\0\0\x14ftypqt  ", False),
        (b"RIFF\0\0\0\0WEBP", True),
        (b"RIFF\0\0\0\0AVI ", False),
        (b"\xff\xd8\xff\xe1", True),
        (b"\x1aE\xdf\xa3", False),
    ],
)
def test_stills_are_told_from_films_by_their_first_bytes(head, is_still, tmp_path):
    (tmp_path / "a").write_bytes(head + bytes(40))
    assert is_image(tmp_path / "a") == is_still


def test_pictures_of_a_folder_come_in_natural_order(tmp_path):
    for name in ("10.PNG", "9.heic", "1.tif", "2.depth.png", "notes.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["1.tif", "9.heic", "10.PNG"]
    assert list_images(tmp_path / "nothing") == []
