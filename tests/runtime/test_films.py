"""Videos: colours by their tag, trimmed ones by what they show, and a high dynamic range told once."""

from __future__ import annotations

import struct
import warnings

import cv2
import numpy as np
import pytest
from films import COLORS, colored_film, patches

from mambaloc.errors import InputWarning
from mambaloc.images import read_image
from mambaloc.importing.video import write_frames
from mambaloc.runtime.mp4 import About, read_about
from mambaloc.runtime.sources import frames_of


def film(path, count=30, fourcc="mp4v"):
    """Frame k is grey of 8 k."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), 30, (64, 48))
    for number in range(count):
        writer.write(np.full((48, 64, 3), 8 * number, np.uint8))
    writer.release()
    return path


def trimmed(path, start, count):
    """Show so many frames from one on, by the edit list that phones write."""
    data = bytearray(path.read_bytes())
    media_hz = struct.unpack_from(">I", data, data.index(b"mdhd") + 16)[0]
    movie_hz = struct.unpack_from(">I", data, data.index(b"mvhd") + 16)[0]
    edit = data.index(b"elst") + 12
    assert struct.unpack_from(">Iii", data, edit) == (movie_hz * 30 // 30, 0, 1 << 16)
    struct.pack_into(">Ii", data, edit, movie_hz * count // 30, media_hz * start // 30)
    path.write_bytes(data)
    return path


def tagged(path, transfer):
    """Add the box of colours, BT.2020 with some transfer, to a video's only track."""
    data = bytearray(path.read_bytes())
    box = struct.pack(">I8s3HB", 19, b"colrnclx", 9, transfer, 9, 0)
    entry = data.index(b"stsd") + 12
    end = entry + struct.unpack_from(">I", data, entry)[0]
    parents = [data.index(name) - 4 for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")]
    for at in (entry, *parents):
        struct.pack_into(">I", data, at, struct.unpack_from(">I", data, at)[0] + len(box))
    data[end:end] = box
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(("start", "count"), [(0, 15), (10, 15)])
def test_a_trimmed_film_counts_what_it_shows(tmp_path, start, count):
    """Guess: OpenCV's number of frames is that of frames it reads. It is the track's: 30, of which it reads 15."""
    path = trimmed(film(tmp_path / "a.mp4"), start, count)
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT) == 30
    frames, told = frames_of(path)
    listed = list(frames)
    assert told == len(listed) == count
    assert [frame.name for frame in listed] == [*map(str, range(count))]
    assert [frame.time_s for frame in listed] == pytest.approx(np.arange(count) / 30, abs=1e-3)
    seen = [frame.image.mean() / 8 for frame in listed]
    assert np.rint(seen).tolist() == [*range(start, start + count)]


def test_a_whole_film_counts_all(tmp_path):
    frames, told = frames_of(film(tmp_path / "a.mp4"))
    assert told == len(list(frames)) == 30


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG")])
def test_a_high_dynamic_range_is_told_once(tmp_path, transfer, name):
    path = tagged(film(tmp_path / "a.mp4", 3), transfer)
    with pytest.warns(InputWarning) as told:
        frames_of(path)
    (warning,) = told
    assert f"a.mp4: is a video with a high dynamic range ({name})" in str(warning.message)
    assert "Record with HDR off" in str(warning.message)


def test_an_ordinary_film_is_told_nothing_of(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frames_of(tagged(film(tmp_path / "a.mp4", 3), 1))
        frames_of(film(tmp_path / "c.avi", 3, "MJPG"))


@pytest.mark.parametrize("at", [0, 5, 9, 40])
def test_a_damaged_film_says_nothing_of_itself(tmp_path, at):
    data = trimmed(film(tmp_path / "a.mp4"), 0, 15).read_bytes()
    (tmp_path / "b.mp4").write_bytes(data[: max(0, data.index(b"elst") - 10 + at)] if at else b"")
    assert read_about(tmp_path / "b.mp4").hdr is None
    assert read_about(tmp_path / "none.mp4") == About()


@pytest.mark.parametrize("standard", ["bt601", "bt709"])
def test_a_films_colors_are_those_of_its_tag(tmp_path, standard):
    """Guess: OpenCV heeds a video's matrix. 4.12 takes every video for BT.601, up to 28 levels off; 5.0 heeds it.

    The video was made for these colours by the standard's matrix; its encoder is off by up to 5 levels itself.
    """
    path = colored_film(tmp_path / "a.webm", standard)
    frames, _ = frames_of(path)
    first = next(frames)
    np.testing.assert_allclose(patches(first.image), COLORS, atol=5)
    write_frames([first], tmp_path)  # what an import trains on
    np.testing.assert_allclose(patches(read_image(tmp_path / "000000.jpg")), patches(first.image), atol=3)
