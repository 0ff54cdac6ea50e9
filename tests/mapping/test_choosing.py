"""Which points a budget keeps, against a plain greedy search and by hand."""

import numpy as np
import pytest

from mambaloc.mapping.choosing import bytes_each, most_useful
from mambaloc.mapping.triangulation import Observations


def _seen(point, frame, rays=None):
    rays = np.full((len(point), 2), 0.05) if rays is None else np.array(rays)
    return Observations(np.array(frame), np.array(point), rays, np.ones(len(point)))


def test_a_key_frame_that_sees_little_keeps_its_point():
    """Frames 0 and 1 see points 0 to 3, frame 2 sees point 4 alone: after two of the first that one is worth most."""
    seen = _seen([0, 0, 1, 1, 2, 2, 3, 3, 4], [0, 1, 0, 1, 0, 1, 0, 1, 2])
    assert sorted(most_useful(seen, 5, 2, 1.0)) == [0, 1]  # worth 2 and 1, as point 4; the first of those that tie
    assert sorted(most_useful(seen, 5, 3, 1.0)) == [0, 1, 4]
    assert most_useful(seen, 5, 3, 1.0)[-1] == 4
    assert sorted(most_useful(seen, 5, 9, 1.0)) == [0, 1, 2, 3, 4]


def test_each_part_of_a_picture_keeps_a_point():
    """Points 0 to 2 lie within an eighth of the image's width, point 3 in another eighth."""
    rays = [(0.01, 0.01), (0.02, 0.02), (0.03, 0.03), (0.30, 0.01)]
    assert sorted(most_useful(_seen([0, 1, 2, 3], [0, 0, 0, 0], rays), 4, 2, 1.0)) == [0, 3]
    assert sorted(most_useful(_seen([0, 1, 2, 3], [0, 0, 0, 0], rays), 4, 2, 8.0)) == [0, 1]


@pytest.mark.parametrize("most", [1, 7, 30, 59])
def test_the_choice_is_that_of_a_plain_greedy_search(most):
    rng = np.random.default_rng(0)
    point, frame = np.nonzero(rng.uniform(size=(60, 9)) < 0.3)
    point = np.unique(point, return_inverse=True)[1]
    rays, points = rng.uniform(-0.5, 0.5, (len(point), 2)), point.max() + 1
    cells = list(map(tuple, np.column_stack((frame, np.floor(rays * 8)))))
    chosen, count = [], dict.fromkeys(cells, 0)
    while len(chosen) < min(most, points):
        worth = [
            sum(1 / (1 + count[cell]) for cell, of in zip(cells, point, strict=True) if of == p) for p in range(points)
        ]
        best = max(set(range(points)) - set(chosen), key=lambda p: (round(worth[p], 9), -p))
        chosen.append(best)
        for cell, of in zip(cells, point, strict=True):
            count[cell] += of == best
    found = most_useful(_seen(point, frame, rays), points, most, 1.0)
    assert sorted(found) == sorted(chosen)
    views = np.bincount(point)[found]
    assert (np.diff(views) <= 0).all()


def test_bytes_of_a_point():
    """Three float32, 128 bytes of descriptor, and a bit a key frame."""
    assert [bytes_each(count) for count in (1, 8, 9, 160)] == [141, 141, 142, 160]


def test_points_that_as_many_see_are_not_in_the_order_of_frames():
    """The first half of 400 points that one frame each sees is from the first half of the frames to less than 60 %."""
    found = most_useful(_seen(np.arange(400), np.arange(400) // 10), 400, 400, 1.0)
    assert (found[:200] < 200).mean() < 0.6
