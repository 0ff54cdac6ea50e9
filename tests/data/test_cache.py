"""The frame cache: the right pixels, decoded once, never from a damaged file or a run that was cut off."""

from __future__ import annotations

import errno
import multiprocessing
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from mambaloc.data import cache
from mambaloc.data.cache import cached_frames
from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError
from mambaloc.user_cache import default_cache_dir

SIZE = (32, 24)


def noise(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    """Four PNG images of noise."""
    folder = tmp_path / "den" / "seq-01"
    folder.mkdir(parents=True)
    paths = [folder / f"frame-{number:06d}.color.png" for number in range(4)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), noise(number))
    return paths


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return tmp_path / "cache"


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one entry with each image that OpenCV decodes."""
    calls: list[int] = []
    decode = cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda *args: calls.append(1) or decode(*args))
    return calls


def caches(store: Path) -> set[str]:
    return {path.name for path in (store / "frames").iterdir() if path.suffix != ".lock"}


def as_rgb_planes(bgr: np.ndarray) -> np.ndarray:
    return np.stack([bgr[..., 2], bgr[..., 1], bgr[..., 0]])


def test_at_its_own_size_an_image_is_itself(images, store):
    found = cached_frames(images, 24, BadFrames(), store)
    assert found.images.dtype == np.uint8
    np.testing.assert_array_equal(found.images, [as_rgb_planes(noise(n)) for n in range(4)])
    assert found.rows.tolist() == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="read-only"):
        found.images[0, 0, 0, 0] = 1


def test_half_size_is_the_mean_of_four_pixels(images, store):
    found = cached_frames(images, 12, BadFrames(), store)
    exact = np.stack([as_rgb_planes(noise(n)) for n in range(4)]).reshape(4, 3, 12, 2, 16, 2).mean((3, 5))
    np.testing.assert_allclose(found.images, exact, atol=0.51)


@pytest.mark.parametrize(("short_side", "how"), [(10, cv2.INTER_AREA), (17, cv2.INTER_AREA), (40, cv2.INTER_LINEAR)])
@pytest.mark.parametrize(("size", "kind"), [((32, 24), "png"), ((24, 32), "png"), ((31, 24), "jpg")])
def test_content_is_opencv_decoded_and_resized(tmp_path, store, short_side, how, size, kind):
    path = tmp_path / f"a.{kind}"
    cv2.imwrite(str(path), noise(5, size))
    width, height = (round(side * short_side / min(size)) for side in size)
    expected = cv2.resize(cv2.imread(str(path)), (width, height), interpolation=how)
    found = cached_frames([path], short_side, BadFrames(), store)
    np.testing.assert_array_equal(found.images[0], as_rgb_planes(expected))


@pytest.mark.parametrize("mode", ["gray", "rgba", "gray16", "rgb16"])
def test_other_pngs_become_eight_bit_rgb(tmp_path, store, mode):
    bgr = noise(3)
    written, expected = {
        "gray": (bgr[..., 0], np.repeat(bgr[..., :1], 3, axis=2)),
        "rgba": (np.dstack([bgr, np.full(bgr.shape[:2], 7, np.uint8)]), bgr),
        "gray16": (bgr[..., 0].astype(np.uint16) * 257, np.repeat(bgr[..., :1], 3, axis=2)),
        "rgb16": (bgr.astype(np.uint16) * 257, bgr),
    }[mode]
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), written)
    found = cached_frames([path], 24, BadFrames(), store)
    np.testing.assert_array_equal(found.images[0], as_rgb_planes(expected))


def test_images_are_decoded_once(images, store, decoded):
    first = cached_frames(images, 24, BadFrames(), store)
    assert len(decoded) == 4
    second = cached_frames(images, 24, BadFrames(), store)
    assert len(decoded) == 4
    np.testing.assert_array_equal(first.images, second.images)


def test_moving_or_touching_a_scene_keeps_its_cache(images, store, decoded, tmp_path):
    cached_frames(images, 24, BadFrames(), store)
    shutil.move(tmp_path / "den", tmp_path / "attic")
    moved = [tmp_path / "attic" / path.relative_to(tmp_path / "den") for path in images]
    for path in moved:
        os.utime(path, (0, 0))
    found = cached_frames(moved, 24, BadFrames(), store)
    assert len(decoded) == 4
    np.testing.assert_array_equal(found.images[3], as_rgb_planes(noise(3)))


def test_one_changed_pixel_makes_a_new_cache(tmp_path, store):
    """The file keeps its size, and its first and last 4 KiB but for the checksum."""
    path, bgr = tmp_path / "a.png", noise(0, (128, 128))
    uncompressed = [cv2.IMWRITE_PNG_COMPRESSION, 0]
    cv2.imwrite(str(path), bgr, uncompressed)
    size = path.stat().st_size
    cached_frames([path], 128, BadFrames(), store)
    bgr[64, 64] ^= 255
    cv2.imwrite(str(path), bgr, uncompressed)
    assert path.stat().st_size == size
    found = cached_frames([path], 128, BadFrames(), store)
    np.testing.assert_array_equal(found.images[0], as_rgb_planes(bgr))


@pytest.mark.parametrize(
    "change",
    [lambda p: p[::-1], lambda p: p[:3], lambda p: [p[0], *p], lambda p: [*p[1:], p[0].with_name("x.png")]],
    ids=["order", "fewer", "twice", "renamed"],
)
def test_another_list_of_images_makes_a_new_cache(images, store, change):
    shutil.copy(images[0], images[0].with_name("x.png"))
    cached_frames(images, 24, BadFrames(), store)
    changed = change(images)
    found = cached_frames(changed, 24, BadFrames(), store)
    assert len(caches(store)) == 2
    np.testing.assert_array_equal(found.images, [as_rgb_planes(cv2.imread(str(path))) for path in changed])


def test_another_short_side_makes_a_new_cache(images, store):
    assert cached_frames(images, 24, BadFrames(), store).images.shape == (4, 3, 24, 32)
    assert cached_frames(images, 12, BadFrames(), store).images.shape == (4, 3, 12, 16)
    assert len(caches(store)) == 2


def png_of_size(width: int, height: int) -> bytes:
    """A PNG whose header claims a size that its pixels do not have."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")


def encoded(kind: str) -> bytes:
    return cv2.imencode(f".{kind}", noise(9))[1].tobytes()


BAD_FILES: dict[str, tuple[Callable[[], bytes | None], str]] = {
    "png cut in the middle": (lambda: encoded("png")[:1000], "image is truncated"),
    "png without its last chunk": (lambda: encoded("png")[:-12], "image is truncated"),
    "jpeg cut in the middle": (lambda: encoded("jpg")[:700], "image is truncated"),
    "jpeg without its end": (lambda: encoded("jpg")[:-2], "image is truncated"),
    "empty": (lambda: b"", "image cannot be decoded"),
    "text": (lambda: b"<html>404: not found</html>", "image cannot be decoded"),
    "png with flipped bits": (
        lambda: encoded("png")[:1000] + b"????" + encoded("png")[1004:],
        "image cannot be decoded",
    ),
    "png of 10^10 pixels": (lambda: png_of_size(100_000, 100_000), "image cannot be decoded"),
    "missing": (lambda: None, "image cannot be read"),
    "another shape": (
        lambda: cv2.imencode(".png", noise(9, (24, 32)))[1].tobytes(),
        "image is 24x32 after resizing, where the first is 32x24",
    ),
}


@pytest.mark.parametrize("case", BAD_FILES)
@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_bad_image_is_named_or_skipped_and_counted(images, store, case, kind):
    make, rule = BAD_FILES[case]
    path = images[2].with_suffix(f".{kind}")  # what a file is called does not matter
    images[2].unlink()
    if (content := make()) is not None:
        path.write_bytes(content)
    images[2] = path
    for _ in range(2):  # built, then found
        with pytest.raises(InputError, match=re.escape(f"{path}: {rule}")) as caught:
            cached_frames(images, 24, BadFrames("error"), store)
        assert "\n" not in str(caught.value)
        found = cached_frames(images, 24, bad := BadFrames("skip"), store)
        assert bad.counts() == {rule: 1}
        assert bad.rejected[0].path == path
        assert found.rows.tolist() == [0, 1, 3]
        assert found.images.shape == (3, 3, 24, 32)
        np.testing.assert_array_equal(found.images, [as_rgb_planes(noise(n)) for n in (0, 1, 3)])


def test_of_several_shapes_the_middle_that_all_hold_is_kept(images, store):
    """The first is cropped, too, though the one that holds less comes later; resized sizes tell what was cropped."""
    cv2.imwrite(str(images[2]), noise(2, (24, 28)))
    cv2.imwrite(str(images[3]), noise(3, (40, 24)))
    found = cached_frames(images, 24, BadFrames("error"), store, min_size=(20, 20))
    assert found.sizes.tolist() == [[24, 32], [24, 32], [28, 24], [24, 40]]
    assert found.images.shape == (4, 3, 24, 24)
    expected = [noise(0)[:, 4:28], noise(1)[:, 4:28], noise(2, (24, 28))[2:26], noise(3, (40, 24))[:, 8:32]]
    np.testing.assert_array_equal(found.images, [as_rgb_planes(each) for each in expected])


def test_a_shape_that_does_not_hold_the_least_is_bad(images, store):
    cv2.imwrite(str(images[2]), noise(2, (24, 28)))
    found = cached_frames(images, 24, bad := BadFrames("skip"), store, min_size=(20, 30))
    assert found.images.shape == (3, 3, 24, 32)
    assert bad.counts() == {"image is 24x28 after resizing, where the first is 32x24": 1}


def test_mended_image_makes_a_new_cache(images, store):
    whole = images[1].read_bytes()
    images[1].write_bytes(whole[:-100])
    assert len(cached_frames(images, 24, BadFrames("skip"), store).images) == 3
    images[1].write_bytes(whole)
    found = cached_frames(images, 24, BadFrames("error"), store)
    np.testing.assert_array_equal(found.images, [as_rgb_planes(noise(n)) for n in range(4)])


def test_first_image_bad(images, store):
    images[0].write_bytes(b"")
    found = cached_frames(images, 24, BadFrames("skip"), store)
    np.testing.assert_array_equal(found.images, [as_rgb_planes(noise(n)) for n in (1, 2, 3)])


def test_no_good_image_is_an_error_even_when_skipping(images, store):
    for path in images:
        path.write_bytes(b"")
    bad = BadFrames("skip")
    with pytest.raises(InputError, match="none of 4 images can be decoded"):
        cached_frames(images, 24, bad, store)
    assert bad.counts() == {"image cannot be decoded": 4}


def test_default_folder_comes_from_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("MAMBALOC_CACHE", raising=False)
    assert default_cache_dir() == tmp_path / "xdg" / "mambaloc"
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path / "mine"))
    assert default_cache_dir() == tmp_path / "mine"


def test_no_folder_given_uses_the_default(images, monkeypatch, tmp_path):
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path / "mine"))
    cached_frames(images, 24, BadFrames())
    assert len(caches(tmp_path / "mine")) == 1


def test_a_file_where_the_cache_belongs_is_an_input_error(images, store):
    store.write_text("not a folder")
    with pytest.raises(InputError, match="the frame cache cannot be written"):
        cached_frames(images, 24, BadFrames(), store)


@contextmanager
def not_root() -> Iterator[None]:
    """Give up root's right to write anywhere, for a while."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs POSIX permissions")
def test_a_read_only_cache_folder_is_an_input_error(images):
    with tempfile.TemporaryDirectory() as folder:  # pytest's own is closed to other users
        Path(folder).chmod(0o555)
        try:
            with not_root(), pytest.raises(InputError, match=r"the frame cache cannot be written.*MAMBALOC_CACHE"):
                cached_frames(images, 24, BadFrames(), Path(folder))
        finally:
            Path(folder).chmod(0o755)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="needs posix_fallocate")
def test_a_full_disk_is_an_input_error(images, store, monkeypatch):
    """Space is claimed before an image is written: a memory map that runs out of it kills the process."""

    def disk_is_full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "posix_fallocate", disk_is_full)
        with pytest.raises(InputError, match=os.strerror(errno.ENOSPC)):
            cached_frames(images, 24, BadFrames(), store)
    assert len(cached_frames(images, 24, BadFrames(), store).images) == 4


def open_at_once(images: list[Path], store: Path, barrier, out: Path) -> None:
    """Run in a process of its own: open the cache at the same moment as the others, and note each build."""
    build = cache._build

    def noting_build(*args) -> None:
        out.with_suffix(".built").touch()
        time.sleep(0.3)  # the others arrive meanwhile
        build(*args)

    cache._build = noting_build
    barrier.wait(300)
    np.save(out, cached_frames(images, 24, BadFrames(), store).images)


def test_two_processes_build_it_once(images, store, tmp_path):
    spawn = multiprocessing.get_context("spawn")
    barrier = spawn.Barrier(2)
    outs = [tmp_path / f"{n}.npy" for n in range(2)]
    processes = [spawn.Process(target=open_at_once, args=(images, store, barrier, out)) for out in outs]
    for process in processes:
        process.start()
    for process in processes:
        process.join(300)
        assert process.exitcode == 0
    assert len(list(tmp_path.glob("*.built"))) == 1
    for out in outs:
        np.testing.assert_array_equal(np.load(out), [as_rgb_planes(noise(n)) for n in range(4)])


STUCK_BUILD = """
import itertools, sys, time, cv2
from pathlib import Path
from mambaloc.data.cache import cached_frames
from mambaloc.data.frames import BadFrames
decode, calls = cv2.imdecode, itertools.count()
cv2.imdecode = lambda *args: time.sleep(600 * (next(calls) > 4)) or decode(*args)
cached_frames([Path(p) for p in sys.argv[2:]], 24, BadFrames(), Path(sys.argv[1]))
"""


def test_a_killed_build_leaves_nothing_that_is_read(tmp_path, store):
    paths = [tmp_path / f"{number}.png" for number in range(20)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), noise(number))
    builder = subprocess.Popen([sys.executable, "-c", STUCK_BUILD, store, *paths])
    try:
        deadline = time.monotonic() + 300
        while not list(store.glob("frames/*.partial/images.npy")):
            assert builder.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.005)
    finally:
        builder.send_signal(signal.SIGKILL)
        builder.wait()
    (leftover,) = caches(store)
    assert leftover.endswith(".partial")
    (store / "frames" / leftover / "old").touch()
    found = cached_frames(paths, 24, BadFrames(), store)
    np.testing.assert_array_equal(found.images, [as_rgb_planes(noise(n)) for n in range(20)])
    assert caches(store) == {leftover.removesuffix(".partial")}
    (folder,) = (path for path in (store / "frames").iterdir() if path.is_dir())
    assert {path.name for path in folder.iterdir()} == {"images.npy", "meta.json"}
