"""A build that is interrupted or repeated goes on with the keypoints and matches that were found before."""

from collections import Counter

import cv2
import numpy as np
import pytest

from mambaloc.errors import InputError
from mambaloc.mapping import MapSettings, PosedFrames, build_map, kept_parts
from mambaloc.mapping.pairs import pairs_by_pose

SETTINGS = MapSettings(key_frames=20, width=160)


@pytest.fixture
def frames(walk, tmp_path, monkeypatch):
    """Twenty frames as files, beside an empty cache."""
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path / "cache"))
    chosen = walk.frames.select(np.arange(0, 40, 2))
    files = [tmp_path / f"{row}.png" for row in range(len(chosen))]
    for file, image in zip(files, chosen.images, strict=True):
        cv2.imwrite(str(file), image[..., ::-1])
    return PosedFrames(files, chosen.intrinsics, chosen.world_from_cam)


@pytest.fixture
def work(monkeypatch):
    """``work.count`` of each function's calls; a function in ``work.most`` stops the build after so many."""

    class Work:
        count, most = Counter(), {}

    def counted(name):
        function = getattr(kept_parts, name)

        def call(*args):
            if Work.count[name] == Work.most.get(name):
                raise KeyboardInterrupt
            Work.count[name] += 1
            return function(*args)

        monkeypatch.setattr(kept_parts, name, call)

    counted("find_keypoints")
    counted("match")
    return Work


def test_an_interrupted_build_goes_on_where_it_was(frames, walk, work, tmp_path):
    """It is stopped among keypoints, then among matches; the map is that of a build without a cache, bit for bit."""
    firsts = pairs_by_pose(frames.world_from_cam)[:, 0]
    work.most = {"find_keypoints": 7}
    with pytest.raises(KeyboardInterrupt):
        build_map(frames, SETTINGS, "room", threads=1)
    assert work.count == {"find_keypoints": 7}

    work.most = {"match": 60}  # a frame's matches are kept once all of them are found
    with pytest.raises(KeyboardInterrupt):
        build_map(frames, SETTINGS, "room", threads=1)
    assert work.count == {"find_keypoints": 20, "match": 60}
    whole = max(count for count in np.searchsorted(firsts, np.arange(20)) if count <= 60)
    assert whole > 40

    work.most, work.count = {}, Counter()
    found = build_map(frames, SETTINGS, "room", threads=1)
    assert work.count == {"match": len(firsts) - whole}

    work.count = Counter()
    build_map(frames, SETTINGS, "room", threads=1).save(tmp_path / "again")
    assert not work.count
    arrays = PosedFrames(walk.frames.images[0:40:2], frames.intrinsics, frames.world_from_cam)
    found.save(tmp_path / "found")
    build_map(arrays, SETTINGS, "room", threads=1).save(tmp_path / "expected")
    assert work.count == {"find_keypoints": 20, "match": len(firsts)}
    assert len({(tmp_path / name).read_bytes() for name in ("found", "again", "expected")}) == 1


def test_what_differs_is_found_again(frames, work):
    build_map(frames, SETTINGS, "room")
    pairs = pairs_by_pose(frames.world_from_cam)

    work.count = Counter()
    longer = PosedFrames(frames.images, frames.intrinsics * [[1.01], [1.01], [1]], frames.world_from_cam)
    build_map(longer, SETTINGS, "room", threads=1)
    assert not work.count  # neither keypoints nor matches depend on the camera

    picture = cv2.imread(str(frames.images[3]))
    cv2.imwrite(str(frames.images[3]), cv2.GaussianBlur(picture, None, 0.6))
    build_map(frames, SETTINGS, "room", threads=1)
    firsts = pairs[(pairs == 3).any(axis=1), 0]  # whose matches with some frame are with this one
    assert work.count == {"find_keypoints": 1, "match": np.isin(pairs[:, 0], firsts).sum()}

    work.count = Counter()
    build_map(frames, MapSettings(key_frames=20, width=150), "room", threads=1)
    assert work.count == {"find_keypoints": 20, "match": len(pairs)}


def test_a_damaged_part_is_named_in_a_line(frames, tmp_path):
    build_map(frames, SETTINGS, "room")
    part = next((tmp_path / "cache" / "keypoints").glob("*/arrays.npz"))
    data = bytearray(part.read_bytes())
    data[len(data) // 2] ^= 1
    for damaged in (bytes(data), data[:99], b""):
        part.write_bytes(damaged)
        with pytest.raises(InputError, match=r"arrays\.npz: is damaged \(.*\)\. Remove .* to have it made again\.$"):
            build_map(frames, SETTINGS, "room")
