"""Points of an imported scene: written, read, selected, and every damage named in one line."""

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from mambaloc.data.datasets.capture import COLUMNS, FRAMES_FILE
from mambaloc.data.frames import Frames
from mambaloc.data.points.tracks import read_track_points
from mambaloc.data.tracks import POINTS_FILE, Tracks, read_tracks
from mambaloc.errors import InputError


@pytest.fixture
def tracks():
    """Three points in four frames: 0 seen by 0 and 2, 1 by 1, 2 by 2 and 3."""
    point, frame = np.array([0, 0, 1, 2, 2]), np.array([0, 2, 1, 2, 3])
    return Tracks(np.arange(9.0).reshape(3, 3), point, frame, np.column_stack((point, frame)) / 10.0)


def test_what_is_written_is_read(tracks, tmp_path):
    assert read_tracks(tmp_path, 4) is None
    tracks.write(tmp_path)
    found = read_tracks(tmp_path, 4)
    for name in ("points_m", "point", "frame", "rays"):
        np.testing.assert_array_equal(getattr(found, name), getattr(tracks, name))


def test_some_frames_see_some_points(tracks):
    """Frames 3 and 2 in that order see points 0 and 2: by hand."""
    found = tracks.of_frames(np.array([3, 2]))
    assert found.points_m.tolist() == [[0, 1, 2], [6, 7, 8]]
    seen = zip(found.point.tolist(), found.frame.tolist(), found.rays.tolist(), strict=True)
    assert sorted(seen) == [(0, 1, [0.0, 0.2]), (1, 0, [0.2, 0.3]), (1, 1, [0.2, 0.2])]
    assert len(tracks.of_frames(np.array([], np.int64))) == 0


def test_points_move_with_the_world(tracks):
    assert tracks.moved(2.0, np.array([1.0, 0, -1])).points_m[1].tolist() == [7, 8, 9]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame": np.array([0, 2, 1, 2, 4])}, r"frame is not within 0 to 3"),
        ({"point": np.array([0, 0, 1, 2, -1])}, r"point is not within 0 to 2"),
        ({"point": np.array([0, 0, 1, 2])}, r"of different lengths"),
        ({"rays": np.full((5, 2), np.nan)}, r"not finite"),
        ({"rays": np.zeros((5, 3))}, r"rays is float64 \(5, 3\)"),
        ({"points_m": np.zeros((3, 3), np.float32)}, r"points_m is float32"),
    ],
)
def test_damage_is_named_in_a_line(tracks, tmp_path, change, message):
    tracks.write(tmp_path)
    path = tmp_path / POINTS_FILE
    save_file({**load_file(path), **change}, path)
    with pytest.raises(InputError, match=rf"{POINTS_FILE}: is damaged \(.*{message}.*\)\. Import the scene again"):
        read_tracks(tmp_path, 4)


def test_a_cut_file_is_damaged(tracks, tmp_path):
    tracks.write(tmp_path)
    path = tmp_path / POINTS_FILE
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"is damaged"):
        read_tracks(tmp_path, 4)


def test_frames_get_the_points_that_they_observe(tracks, tmp_path):
    """Frames 3 and 1 of four, in that order: points 2 and 1; frame 3 and another have one each."""
    rows = [f"{row}.png,walk,,0,0,0,1,0,0,0,lens,train" for row in range(4)]
    (tmp_path / FRAMES_FILE).write_text("\n".join([",".join(COLUMNS), *rows]))
    tracks.write(tmp_path)
    images = tuple(tmp_path / f"{row}.png" for row in (3, 1))
    frames = Frames(images, ("walk", "walk"), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    points = read_track_points(tmp_path, frames, 3, seed=0)
    assert points.source == "tracks"
    assert points.per_frame().tolist() == [1, 1]
    assert points.points_m[:, 0].tolist() == [[6, 7, 8], [3, 4, 5]]
