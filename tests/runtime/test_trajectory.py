"""TUM trajectories: clock times to the nanosecond, and what evo and pycolmap read of them."""

from __future__ import annotations

import os
import subprocess
import sys
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.runtime.trajectory import write_tum

FIRST_S = 1305031102.175304  # of TUM's first recording
COUNT = 60


@pytest.fixture
def trajectory():
    """Epoch seconds 33 ms apart, positions, and quaternions wxyz; float32, as networks give them."""
    rng = np.random.default_rng(0)
    times_s = FIRST_S + np.arange(COUNT) / 30
    position_m = np.cumsum(rng.normal(0, 0.02, (COUNT, 3)), axis=0).astype(np.float32)
    xyzw = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.02, (COUNT, 3)), axis=0)).as_quat()
    return times_s, position_m, np.roll(xyzw, 1, axis=1).astype(np.float32)


def test_times_keep_nanoseconds_and_positions_their_digits(tmp_path, trajectory):
    _, position_m, quaternion = trajectory
    nanoseconds = [1403636579763555584 + k * 50_000_001 for k in range(COUNT)]
    write_tum(tmp_path / "a.tum", [Decimal(ns).scaleb(-9) for ns in nanoseconds], position_m, quaternion)
    rows = [line.split() for line in (tmp_path / "a.tum").read_text().splitlines()[1:]]
    assert [int(row[0].replace(".", "")) for row in rows] == nanoseconds
    numbers = np.array([row[1:] for row in rows], float)
    np.testing.assert_array_equal(numbers.astype(np.float32)[:, :3], position_m)
    np.testing.assert_array_equal(numbers.astype(np.float32)[:, [6, 3, 4, 5]], quaternion)


def test_clock_times_survive_as_float64_has_them(tmp_path, trajectory):
    write_tum(tmp_path / "a.tum", *trajectory)
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "a.tum")[:, 0], trajectory[0])


def test_indices_stay_whole_numbers(tmp_path, trajectory):
    write_tum(tmp_path / "a.tum", range(COUNT), *trajectory[1:])
    assert [line.split()[0] for line in (tmp_path / "a.tum").read_text().splitlines()[1:]] == [*map(str, range(COUNT))]


def test_rows_without_a_pose_are_left_out(tmp_path, trajectory):
    """Guess: evo refuses a row of zeros. It takes it for a pose at the origin (1.38.1), so no such row is written."""
    times_s, position_m, quaternion = (each.copy() for each in trajectory)
    quaternion[3], position_m[3], position_m[5], quaternion[7] = 0, 0, np.nan, np.nan
    position_m[9] = 0  # with a rotation it is one
    write_tum(tmp_path / "a.tum", times_s, position_m, quaternion)
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "a.tum")[:, 0], np.delete(times_s, [3, 5, 7]))


@pytest.mark.parametrize(("option", "unit", "expected"), [("trans_part", "m", 0.05), ("angle_deg", "deg", 1.0)])
def test_evo_pairs_every_pose_and_measures_rotations(option, unit, expected, tmp_path, trajectory):
    """evo pairs by time, and refuses to measure rotations whose digits are too few (1.38.1: six)."""
    evo_ape = Path(sys.executable).with_name("evo_ape")
    if not evo_ape.is_file():
        pytest.skip("evo is an oracle of this test alone; pip install evo==1.38.1")
    times_s, position_m, quaternion = trajectory
    write_tum(tmp_path / "true.tum", times_s, position_m, quaternion)
    turn = Rotation.from_rotvec([0, 0, np.radians(1.0)])
    turned = (Rotation.from_quat(np.roll(quaternion, -1, axis=1)) * turn).as_quat()
    write_tum(tmp_path / "found.tum", times_s, position_m + np.array([0.03, 0, 0.04]), np.roll(turned, 1, axis=1))
    command = [evo_ape, "tum", "true.tum", "found.tum", "-r", option, "--t_max_diff", "1e-6", "-v"]
    home = {**os.environ, "HOME": str(tmp_path)}  # evo writes its settings there
    said = subprocess.run(command, cwd=tmp_path, env=home, capture_output=True, text=True, check=True).stdout
    assert f"Compared {COUNT} absolute pose pairs" in said
    figures = dict(line.split() for line in said.splitlines() if len(line.split()) == 2)
    assert float(figures["median"]) == pytest.approx(expected, rel=1e-4), unit
    assert float(figures["max"]) == pytest.approx(expected, rel=1e-3), unit


def test_pycolmap_takes_the_rotations_as_they_are(tmp_path, trajectory):
    """pycolmap never normalises: matrix and inverse of a quaternion agree only where its digits make it unit."""
    pycolmap = pytest.importorskip("pycolmap", reason="an oracle of this test; the extra [colmap]")
    write_tum(tmp_path / "a.tum", *trajectory)
    for row in np.loadtxt(tmp_path / "a.tum"):
        world_from_cam = pycolmap.Rigid3d(pycolmap.Rotation3d(row[4:]), row[1:4])
        there_and_back = (world_from_cam * world_from_cam.inverse()).matrix()
        np.testing.assert_allclose(there_and_back, np.eye(4)[:3], atol=1e-6)
        np.testing.assert_allclose(world_from_cam.rotation.matrix(), Rotation.from_quat(row[4:]).as_matrix(), atol=1e-6)
