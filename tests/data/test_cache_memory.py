"""The frame cache is larger than the memory that making and reading it take."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mambaloc.data import cache
from mambaloc.data.cache import cached_frames
from mambaloc.data.frame_dataset import CachedFrames
from mambaloc.data.frames import BadFrames, Cameras, Frames


@pytest.mark.skipif(sys.platform != "linux", reason="read from /proc")
def test_neither_building_nor_reading_maps_the_whole_file(tmp_path, monkeypatch):
    """Of 144 MiB at most a window of 128 frames is this process's memory, whatever the number of frames."""
    frame = np.full((3, 256, 256), 7, np.uint8)
    monkeypatch.setattr(cache, "_decode", lambda path, short_side: frame)
    monkeypatch.setattr(cache, "fingerprint", lambda path: path.name.encode())
    mapped_kib = []

    def watched(frames, total):
        for each in frames:
            mapped_kib.append(rss_of_files_kib())
            yield each

    monkeypatch.setattr(cache, "_with_progress", watched)
    before = rss_of_files_kib()
    found = cached_frames([tmp_path / f"{n}.jpg" for n in range(768)], 256, BadFrames(), tmp_path / "cache")
    assert len(found.images) == 768
    assert max(mapped_kib) - before < 40 * 1024
    poses = np.tile([0.0, 0, 0, 1, 0, 0, 0], (768, 1))
    names = tuple(tmp_path / str(number) for number in range(768))
    frames = Frames(names, ("seq",) * 768, poses[:, :3], poses[:, 3:])
    cameras = Cameras(np.tile(np.eye(3), (768, 1, 1)), np.full((768, 2), 256), is_assumed=True)
    data = CachedFrames(frames, found.images, cameras)
    for start in range(0, 768, 8):
        assert (data.images_at(range(start, start + 8)) == 7).all()
    assert rss_of_files_kib() - before < 8 * 1024


def test_few_images_are_decoded_ahead(monkeypatch):
    calls: list[int] = []
    monkeypatch.setattr(cache, "_decode", lambda path, short_side: calls.append(1) or np.zeros((3, 2, 2), np.uint8))
    frames = cache._decoded([Path(str(n)) for n in range(1000)], 2)
    next(frames)
    assert len(calls) <= 128
    assert len(list(frames)) == 999
    assert len(calls) == 1000


def rss_of_files_kib() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssFile"))
