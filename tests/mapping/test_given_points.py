"""Maps of points that were given: rendered frames, whose keypoints are lifted by exact depth."""

import dataclasses

import numpy as np
import pytest

from mambaloc.data.tracks import Tracks
from mambaloc.mapping import MapSettings, build_map
from mambaloc.mapping.building import describe_points
from mambaloc.mapping.evaluating import measure
from mambaloc.runtime.maps.features import detect_features

SETTINGS = MapSettings(key_frames=40, width=160, points="colmap")


@pytest.fixture(scope="module")
def given(walk):
    """Every second frame, and points at its keypoints that the fourth frame before it sees too."""
    rows = np.arange(0, 80, 2)
    frames = walk.frames.select(rows)
    points, point, frame, rays = [], [], [], []
    for row in range(40):
        found = detect_features(frames.images[row], frames.intrinsics[row], 1.0)
        x, y = np.clip(np.rint(found.pixels).astype(int), 0, (159, 119)).T
        cam = np.column_stack((found.rays, np.ones(len(found)))) * walk.depth_m[rows[row], y, x][:, None]
        world = cam @ frames.world_from_cam[row][:3, :3].T + frames.world_from_cam[row][:3, 3]
        for other in (row, (row - 2) % 40):
            inverse = np.linalg.inv(frames.world_from_cam[other])
            seen = world @ inverse[:3, :3].T + inverse[:3, 3]
            point.append(np.arange(len(world)) + sum(map(len, points)))
            frame.append(np.full(len(world), other))
            rays.append(seen[:, :2] / seen[:, 2:])
        points.append(world)
    tracks = Tracks(*(np.concatenate(each) for each in (points, point, frame, rays)))
    return dataclasses.replace(frames, tracks=tracks)


@pytest.fixture(scope="module")
def room(given):
    return build_map(given, SETTINGS, "room")


def test_points_and_poses_are_used_as_they_are(room, given):
    assert len(room) > 1000
    assert set(map(bytes, room.points_m)) <= set(map(bytes, given.tracks.points_m.astype(np.float32)))
    np.testing.assert_array_equal(room.key_poses, given.world_from_cam)
    assert len(room.drift) == 0
    assert room.lens.numbers.tolist() == [1, 0]
    assert describe_points(room) == f"points from COLMAP: {len(room)}"


def test_frames_of_another_walk_are_localized(room, other_walk):
    """Measured: a median of 0.006 m, worst 0.02 m."""
    found = measure(room, other_walk.frames, (0,))
    assert found.is_accepted.all()
    assert np.median(found.position_m) < 0.01
    assert found.position_m.max() < 0.04


def test_own_points_are_triangulated_where_asked(given):
    own = build_map(given, dataclasses.replace(SETTINGS, points="triangulated"), "room")
    same = build_map(dataclasses.replace(given, tracks=None), SETTINGS, "room")
    np.testing.assert_array_equal(own.points_m, same.points_m)
    assert describe_points(own) == f"points triangulated: {len(own)}"


def test_a_selection_keeps_its_tracks(given):
    some = given.select(np.array([5, 3]))
    rows = np.flatnonzero(given.tracks.frame == 3)
    np.testing.assert_array_equal(some.tracks.rays[some.tracks.frame == 1], given.tracks.rays[rows])


def test_a_scene_whose_frames_see_no_point_has_its_own_triangulated(given):
    few = dataclasses.replace(given, tracks=given.tracks.of_frames(np.array([], np.int64)))
    assert describe_points(build_map(few, SETTINGS, "room")).startswith("points triangulated")
