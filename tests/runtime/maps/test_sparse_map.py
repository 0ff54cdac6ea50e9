"""Maps on disk: what is written is read, and nothing else is."""

import contextlib
import dataclasses
import json
import zlib

import numpy as np
import pytest
from safetensors.numpy import load, save

from mambaloc.errors import InputError
from mambaloc.runtime.maps.acceptance import RULE
from mambaloc.runtime.maps.sparse_map import VERSION, SparseMap


@pytest.fixture
def sparse_map():
    rng = np.random.default_rng(0)
    return SparseMap(
        points_m=rng.normal(size=(9, 3)).astype(np.float32),
        descriptors=rng.integers(0, 256, (9, 128), dtype=np.uint8),
        views=np.packbits(rng.random((9, 10)) < 0.5, axis=1),
        key_poses=np.tile(np.eye(4), (10, 1, 1)),
        size=(160, 120),
        intrinsics=np.array([[131.0, 0, 79.5], [0, 131, 59.5], [0, 0, 1]]),
        least_inliers=12,
        scene="den",
        digests={"frames": "abc"},
    )


def test_a_map_comes_back_as_it_was(sparse_map, tmp_path):
    path = tmp_path / "new" / "map.safetensors"
    sparse_map.save(path)
    loaded = SparseMap.load(path)
    for field in dataclasses.fields(SparseMap):
        before, after = getattr(sparse_map, field.name), getattr(loaded, field.name)
        assert type(before) is type(after)
        np.testing.assert_array_equal(before, after)
    assert [file.name for file in path.parent.iterdir()] == ["map.safetensors"]


def test_a_file_says_what_its_map_accepts(sparse_map, tmp_path):
    sparse_map.save(tmp_path / "map.safetensors")
    _, about = _parts(tmp_path / "map.safetensors")
    assert (about["rule"], about["least_inliers"]) == (RULE, 12)


def test_the_same_map_is_the_same_file(sparse_map, tmp_path):
    sparse_map.save(tmp_path / "a.npz")
    sparse_map.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def _parts(path):
    data = path.read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return load(data), json.loads(header["__metadata__"]["about"])


def _write(path, arrays, about):
    """With the checksum that the arrays have, so that only what was changed is wrong."""
    if isinstance(about, dict):
        about["crc32"] = zlib.crc32(b"".join(arrays[name].tobytes() for name in sorted(arrays)))
    path.write_bytes(save(arrays, {"about": about if isinstance(about, str) else json.dumps(about)}))


CHANGES = {
    "a newer version": {"about": {"version": VERSION + 1}},
    "a version that is a word": {"about": {"version": "x"}},
    "no JSON": {"about": "[["},
    "a list for a record": {"about": "[]"},
    "digests that are a number": {"about": {"digests": 3}},
    "inliers that are a word": {"about": {"least_inliers": "many"}},
    "a lens that is a number": {"about": {"undistortion": 7}},
    "points in float64": {"points_m": np.zeros((9, 3))},
    "a point too few": {"points_m": np.zeros((8, 3), np.float32)},
    "NaN": {"points_m": np.full((9, 3), np.nan, np.float32)},
    "no point": {
        "points_m": np.zeros((0, 3), np.float32),
        "descriptors": np.zeros((0, 128), np.uint8),
        "views": np.zeros((0, 2), np.uint8),
    },
    "short descriptors": {"descriptors": np.zeros((9, 64), np.uint8)},
    "views of fewer key frames": {"views": np.zeros((9, 1), np.uint8)},
    "no size": {"size": np.array([0, 120])},
    "a number for intrinsics": {"intrinsics": np.array(3.0)},
    "intrinsics of another image": {"intrinsics": np.eye(3)},
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_no_map_is_refused_in_a_line(change, sparse_map, tmp_path):
    path = tmp_path / "map.safetensors"
    sparse_map.save(path)
    arrays, about = _parts(path)
    changes = dict(CHANGES[change])
    told = changes.pop("about", {})
    _write(path, arrays | changes, told if isinstance(told, str) else about | told)
    with pytest.raises(InputError, match=r"Update mambaloc" if change == "a newer version" else r"Build the map"):
        SparseMap.load(path)


@pytest.mark.parametrize("name", ["points_m", "views"])
def test_a_map_that_lacks_a_part_is_refused(name, sparse_map, tmp_path):
    path = tmp_path / "map.safetensors"
    sparse_map.save(path)
    arrays, about = _parts(path)
    del arrays[name]
    _write(path, arrays, about)
    with pytest.raises(InputError, match=r"damaged or not a map"):
        SparseMap.load(path)


def test_a_map_without_its_description_is_refused(sparse_map, tmp_path):
    path = tmp_path / "map.safetensors"
    sparse_map.save(path)
    path.write_bytes(save(_parts(path)[0]))
    with pytest.raises(InputError, match=r"damaged or not a map"):
        SparseMap.load(path)


def test_damaged_bytes_are_refused_wherever_they_are(sparse_map, tmp_path):
    """Cut short, or with a byte changed: no other error, and hardly ever none."""
    path = tmp_path / "map.safetensors"
    sparse_map.save(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for damage in range(300):
        data = bytearray(whole)
        if damage < 50:
            del data[int(rng.integers(len(data))) :]
        else:
            data[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        with contextlib.suppress(InputError):
            SparseMap.load(path)
            refused -= 1
        refused += 1
    assert refused > 200


@pytest.mark.parametrize("what", ["missing", "folder", "text"])
def test_what_is_no_file_of_ours_is_refused(what, tmp_path):
    path = tmp_path / "map.safetensors"
    if what == "folder":
        path.mkdir()
    elif what == "text":
        path.write_text("hello")
    with pytest.raises(InputError, match=r"map\.safetensors: (cannot be read|is damaged or not a map)"):
        SparseMap.load(path)


def test_a_map_that_cannot_be_written_is_told(sparse_map, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot be written.*choose another folder"):
        sparse_map.save(tmp_path / "file" / "map.safetensors")
