"""Frames without a fix: what a logger or a tracker writes is told from a camera that is at the origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from captures import capture_of, line, poses_at

from mambaloc.importing.checks.fixes import astray, without_fix
from mambaloc.importing.motion import motion_of, sides_of
from mambaloc.importing.world import in_its_world


def lost(poses, rows=()):
    """Rows that are found to have no fix, once some are at the origin of the world."""
    poses = poses.copy()
    poses[list(rows)] = np.eye(4)
    images = [Path(f"{row}.jpg") for row in range(len(poses))]
    return sorted(without_fix(poses, ["a"] * len(poses), images))


def test_numbers_that_are_none_are_no_fix():
    poses = poses_at(line(30))
    poses[4, 0, 3], poses[9, 1, 1] = np.nan, -np.inf
    assert lost(poses) == [4, 9]


def test_the_origin_is_no_fix_where_the_camera_cannot_have_gone():
    away = poses_at(line(30) + np.array((2, 1, 0)))
    assert lost(away, (3, 4, 17)) == [3, 4, 17]
    grid = poses_at(line(30) + np.array((441548, 5121946, 346)))
    assert lost(grid, (0, 1, 2, 29)) == [0, 1, 2, 29]


def test_the_origin_is_where_a_recording_begins():
    poses = poses_at(line(30))
    poses[:, :3, :3] = np.eye(3)
    assert not poses[0, :3, 3].any()
    assert lost(poses) == []
    back = poses_at(np.concatenate((line(30)[::-1], line(30)[1:])))
    assert lost(back) == []


def test_pictures_in_another_order_than_that_of_their_names():
    """Poses come shuffled; the frames around one are those of neighbouring names."""
    poses, rng = poses_at(line(30) + np.array((2, 1, 0))), np.random.default_rng(0)
    poses[12] = np.eye(4)
    order = rng.permutation(30)
    images = [Path(f"{row}.jpg") for row in order]
    assert sorted(without_fix(poses[order], ["a"] * 30, images)) == [int(np.flatnonzero(order == 12)[0])]


def test_a_frame_in_another_country_is_astray_and_one_in_another_building_is_not():
    poses = poses_at(line(30))
    poses[3, :3, 3], poses[7, :3, 3] = (3e5, 0, 0), (800, 0, 0)
    assert list(astray(poses)) == [3]


def test_two_strays_move_no_measure():
    poses = poses_at(line(24))
    strays = poses.copy()
    strays[[5, 15], 0, 3] = 50.0
    measures = [motion_of(capture_of(each)) for each in (poses, strays)]
    assert measures[1].extent == pytest.approx(measures[0].extent, rel=0.15)
    assert measures[1].step == pytest.approx(measures[0].step)
    assert sides_of(strays[:, :3, 3]).max() < 3


@pytest.mark.parametrize("scale", [None, 0.3048])
def test_a_worlds_offset_is_data(scale):
    truth = line(30) + np.array((441548.2072, 5121946.5531, 346.5648))
    capture, left_out = in_its_world(capture_of(poses_at(truth), unit="unknown"), scale)
    world = capture.world
    assert (left_out, world.metres_per_unit) == ({}, scale or 1.0)
    in_float32 = capture.world_from_cam[:, :3, 3].astype(np.float32)
    np.testing.assert_allclose(world.position_m(in_float32) / world.metres_per_unit, truth, atol=2e-6)


def test_a_world_that_is_near_is_kept():
    capture, _ = in_its_world(capture_of(poses_at(line(30) + np.array((300, 0, 0)))), None)
    assert capture.world.offset_m == (0, 0, 0)
