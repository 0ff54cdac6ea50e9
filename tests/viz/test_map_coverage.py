"""The image of a map's coverage: what it says to film next, by hand-made surveys, and that everything is drawn."""

import numpy as np
import pytest

from mambaloc.images import read_image
from mambaloc.rendering.trajectories import looking
from mambaloc.runtime.maps import SparseMap
from mambaloc.viz.coverage import Survey, describe_gaps, gaps, survey, upwards, write_coverage

HEADINGS = np.arange(12) * np.pi / 6


@pytest.fixture
def wall():
    """A map of what is at x = 2 to 3, seen from five places by cameras that look along x; z is up."""
    rng = np.random.default_rng(0)
    points_m = np.column_stack((rng.uniform(2, 3, 900), rng.uniform(-4, 4, 900), rng.uniform(0, 3, 900)))
    place = np.column_stack((np.zeros(5), np.linspace(-2, 2, 5), np.full(5, 1.5)))
    poses = looking(place, np.zeros(5), np.zeros(5), np.zeros(5))
    intrinsics = np.array([[140.0, 0, 79.5], [0, 140, 59.5], [0, 0, 1]])
    views = np.packbits(np.ones((900, 5), bool), axis=1)
    return SparseMap(
        points_m.astype(np.float32), np.zeros((900, 128), np.uint8), views, poses, (160, 120), intrinsics, 12, "wall"
    )


def test_cameras_that_look_at_the_wall_are_sure_and_others_lost(wall):
    found = survey(wall)
    assert np.allclose(found.axes[2], (0, 0, 1))
    assert {name.removeprefix("-") for name in found.names[:2]} == {"x", "y"}
    level = np.cos(found.headings)[:, None] * found.axes[0] + np.sin(found.headings)[:, None] * found.axes[1]
    near = np.linalg.norm(found.places[:, None] - wall.key_poses[:, :3, 3] @ found.axes[:2].T, axis=2).min(axis=1) < 0.3
    assert (found.certainty[near][:, level[:, 0] > 0.99] > 0.5).all()
    assert (found.certainty[near][:, level[:, 0] < -0.5] == 0).all()


def test_a_gap_lies_beside_what_is_known():
    """A row of places: all know the first direction, those on the left the second, too; none the others."""
    places = np.column_stack((np.arange(9.0), np.zeros(9)))
    certainty = np.zeros((9, 12))
    certainty[:, 0] = 1
    certainty[:5, 1] = 1
    found = Survey(np.eye(3), ["x", "y", "z"], places, 1.0, HEADINGS, 100 * certainty, certainty)
    first = gaps(found, places)[0]
    assert first.matches == 0
    angle = np.degrees(np.arctan2(first.direction[1], first.direction[0]))
    assert -31 < angle < 61  # 30 degrees from one of those that are known, at most
    lines = describe_gaps(found, gaps(found, places)).splitlines()
    assert 1 <= len(lines) <= 3
    assert lines[0].startswith(f"film next 1: from x {first.place[0]:.1f}, y 0.0, looking towards +x")


def test_a_place_that_is_known_all_around_has_no_gap():
    places, certainty = np.column_stack((np.arange(4.0), np.zeros(4))), np.ones((4, 12))
    found = Survey(np.eye(3), ["x", "-y", "z"], places, 1.0, HEADINGS, 100 * certainty, certainty)
    assert gaps(found, places) == []
    assert describe_gaps(found, []).startswith("no gaps")


def test_names_that_count_backwards_are_turned_round():
    certainty = np.zeros((1, 12))
    found = Survey(np.eye(3), ["x", "-y", "z"], np.array([[1.0, 2.0]]), 1.0, HEADINGS, certainty, certainty)
    gap = gaps(found, found.places)[:1]
    gap[0].direction[:] = (0, 1)
    assert "from x 1.0, y -2.0, looking towards -y," in describe_gaps(found, gap)


def test_up_is_an_axis_of_the_world_where_cameras_are_about_upright():
    level = looking(np.zeros((4, 3)), np.arange(4.0), np.full(4, -0.2), np.zeros(4))
    assert upwards(level).tolist() == [0, 0, 1]
    tilted = looking(np.zeros((4, 3)), np.zeros(4), np.full(4, 0.8), np.zeros(4))
    assert np.linalg.norm(upwards(tilted)) == pytest.approx(1)
    assert 0.5 < upwards(tilted)[2] < 0.9


def test_the_picture_has_every_part(wall, tmp_path):
    text = write_coverage(wall, tmp_path / "coverage.png")
    assert text.startswith("film next 1: ")
    colors = {tuple(color) for color in read_image(tmp_path / "coverage.png").reshape(-1, 3)[::7].tolist()}
    for name, color in (("lost", (178, 24, 43)), ("gap", (17, 17, 17)), ("point", (154, 154, 154))):
        assert any(max(abs(a - b) for a, b in zip(color, each, strict=True)) <= 6 for each in colors), name
