"""Recordings for Rerun, read back by Rerun's own reader: poses against SciPy, other values computed by hand."""

from __future__ import annotations

import runpy
import sys
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.images import decode_image
from mambaloc.rendering import default_intrinsics, embedded_walk
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.world import World
from mambaloc.viz.rerun_recording import rerun_recording

pytest.importorskip("rerun", reason="needs the extra rerun")

SIZE, COUNT, LOST = (64, 48), 4, 2
K = default_intrinsics(SIZE)
OFFSET_M = np.array((4.0e6, 5.0e5, 100.0))
COVARIANCE_M2 = np.diag((0.04, 0.01, 0.0025))  # of the first frame, turned
TURN = Rotation.from_euler("zyx", (30, 20, 10), degrees=True)
FIRST = np.datetime64(1_700_000_000_123_456_789, "ns")


def columns(path: Path) -> dict[str, dict]:
    """Values by entity and component: rows of (frame, value), or the value of what is static."""
    from rerun.chunk import RrdReader

    found: dict[str, dict] = defaultdict(dict)
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        frames = batch.column("frame").to_pylist() if "frame" in batch.schema.names else None
        for name in batch.schema.names:
            if ":" in name or name == "time":
                values = batch.column(name).to_pylist()
                rows = found[chunk.entity_path].setdefault(name, {} if frames else values)
                if frames:
                    rows |= dict(zip(frames, values, strict=True))
    return found


@pytest.fixture(scope="module")
def poses():
    return embedded_walk(COUNT, 1, start_deg=20.0, step_deg=10.0)


@pytest.fixture(scope="module")
def pictures(poses):
    """Smooth, as JPEG keeps them, and each channel another."""
    x, y = np.meshgrid(np.linspace(0, 200, SIZE[0]), np.linspace(0, 200, SIZE[1]))
    return [np.stack((x, y, np.full_like(x, 60 * row)), axis=-1).astype(np.uint8) for row in range(len(poses))]


def quaternion(pose):
    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True, canonical=True)


@pytest.fixture(scope="module")
def recording(poses, pictures, tmp_path_factory):
    """Four frames: one found by a map, one by a network, one lost, one without radii or intrinsics."""
    path = tmp_path_factory.mktemp("rerun") / "walk.rrd"
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = TURN.as_matrix() @ COVARIANCE_M2 @ TURN.as_matrix().T
    more = [
        {
            "source": "map",
            "covariance": covariance,
            "position_radius_m": 0.4,
            "rotation_radius_deg": 2.0,
            "inliers": 90,
        },
        {"position_radius_m": 0.25, "rotation_radius_deg": 3.0, "unfamiliarity": 0.5},
        {"source": None},
        {},
    ]
    with rerun_recording(path, "den", World(tuple(OFFSET_M))) as writing:
        for row, pose in enumerate(poses):
            estimated_m = OFFSET_M + pose[:3, 3] + (0.03, 0.04, 0.0)
            turned = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_rotvec((0, np.radians(5), 0))
            estimate = estimated_m, turned.as_quat(scalar_first=True, canonical=True)
            if row == LOST:
                estimate = np.full(3, np.nan), np.full(4, np.nan)
            found = Localization(*estimate, 0.0, **more[row])
            when = FIRST + np.timedelta64(row, "s")
            truth = OFFSET_M + pose[:3, 3], quaternion(pose)
            writing.add_frame(pictures[row], found, when, K if row < 3 else None, truth)
    return path


def test_poses_are_those_that_were_given(recording, poses):
    """Guess: Transform3D is parent_from_child with an xyzw quaternion, in float32."""
    found = columns(recording)
    for entity, offset_m, turn in (("truth", (0, 0, 0), 0), ("camera", (0.03, 0.04, 0), np.radians(5))):
        told = found[f"/world/{entity}"]
        rows = range(COUNT) if entity == "truth" else [0, 1, 3]
        assert list(told["Transform3D:translation"]) == list(rows)
        for row in rows:
            np.testing.assert_allclose(told["Transform3D:translation"][row][0], poses[row][:3, 3] + offset_m, atol=1e-6)
            expected = Rotation.from_matrix(poses[row][:3, :3]) * Rotation.from_rotvec((0, turn, 0))
            off = Rotation.from_quat(told["Transform3D:quaternion"][row][0]).inv() * expected
            assert off.magnitude() < 1e-6
    assert list(found["/world/camera"]["Clear:is_recursive"]) == [LOST]


def test_a_frustum_has_the_true_intrinsics_and_opencv_axes(recording):
    """Rerun's pixels begin at their corners, so the centre is half a pixel on; its matrices go by columns."""
    told = columns(recording)["/world/camera/image"]
    assert list(told["Pinhole:image_from_camera"]) == [0, 1]
    matrix = np.reshape(told["Pinhole:image_from_camera"][0][0], (3, 3)).T
    np.testing.assert_allclose(matrix, K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), rtol=1e-6)
    assert told["Pinhole:resolution"][0][0] == list(SIZE)
    assert told["Pinhole:camera_xyz"][0][0] == [3, 2, 5]  # right, down, forward of its ViewDir


def test_pictures_are_jpeg_of_every_frame(recording, pictures):
    told = columns(recording)["/world/camera/image"]
    assert list(told["EncodedImage:blob"]) == list(range(COUNT))
    for row, picture in enumerate(pictures):
        assert told["EncodedImage:media_type"][row] == ["image/jpeg"]
        image = decode_image(bytes(told["EncodedImage:blob"][row][0]))
        assert np.abs(image.astype(float) - picture).mean() < 4


def test_radii_are_an_ellipsoid_or_a_sphere(recording, poses):
    """By hand: 6.2514 is chi-squared's quantile 0.9 for three dimensions, and axes come from the smallest on."""
    told = columns(recording)["/world/radius"]
    assert list(told["Ellipsoids3D:half_sizes"]) == [0, 1]
    half_m = np.array(told["Ellipsoids3D:half_sizes"][0][0])
    np.testing.assert_allclose(half_m, np.sqrt(6.2514 * np.array((0.0025, 0.01, 0.04))), rtol=1e-4)
    axes = Rotation.from_quat(told["Ellipsoids3D:quaternions"][0][0]).as_matrix()
    expected = 6.2514 * TURN.as_matrix() @ COVARIANCE_M2 @ TURN.as_matrix().T
    np.testing.assert_allclose(axes @ np.diag(half_m**2) @ axes.T, expected, atol=1e-5)
    np.testing.assert_allclose(told["Ellipsoids3D:half_sizes"][1][0], 0.25)
    np.testing.assert_allclose(told["Ellipsoids3D:centers"][1][0], poses[1][:3, 3] + (0.03, 0.04, 0), atol=1e-6)


def test_errors_radii_and_times_by_hand(recording):
    found = columns(recording)
    errors_m = found["/plots/position_error_m"]["Scalars:scalars"]
    assert list(errors_m) == [0, 1, 3]
    np.testing.assert_allclose([errors_m[row][0] for row in errors_m], 0.05, atol=1e-8)
    turned = found["/plots/rotation_error_deg"]["Scalars:scalars"]
    np.testing.assert_allclose([turned[row][0] for row in turned], 5.0, atol=1e-6)
    assert found["/plots/position_radius_m"]["Scalars:scalars"] == {0: [0.4], 1: [0.25]}
    assert found["/plots/inliers"]["Scalars:scalars"] == {0: [90.0]}
    times = found["/world/truth"]["time"]
    stamps = [np.datetime64(getattr(each, "value", each), "ns") for each in times.values()]
    assert stamps == [FIRST + np.timedelta64(row, "s") for row in range(COUNT)]
    assert len(found["/world/true_path"]["LineStrips3D:strips"][0][0]) == COUNT
    assert len(found["/world/estimated_path"]["LineStrips3D:strips"][0][0]) == COUNT - 1


def test_it_opens_with_a_layout(recording):
    from rerun.chunk import RrdReader

    (blueprint,) = RrdReader(recording).blueprints()
    assert blueprint.application_id == RrdReader(recording).recordings()[0].application_id == "mambaloc"


def test_an_error_leaves_no_file(pictures, tmp_path):
    def broken():
        with rerun_recording(tmp_path / "a.rrd", "den") as writing:
            writing.add_frame(pictures[0], Localization(np.zeros(3), np.array([1.0, 0, 0, 0]), 0.0), 0.0)
            raise InputError("broken")

    with pytest.raises(InputError, match="broken"):
        broken()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "says"),
    [("a.txt", "Give a file that ends in .rrd"), ("nowhere/a.rrd", "its folder does not exist"), ("", ".rrd")],
)
def test_wrong_names_are_told_in_a_line(tmp_path, name, says):
    with pytest.raises(InputError, match=says), rerun_recording(tmp_path / name, "den"):
        pass


def test_a_missing_extra_is_told_in_a_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"needs rerun-sdk\. Run pip install 'mambaloc\[rerun\]'"):
        rerun_recording(tmp_path / "a.rrd", "den").__enter__()


def test_localize_records_a_folder(bundle_of_tensors, pictures, tmp_path, monkeypatch, capsys):
    """The poses are those of the trajectory that is written beside."""
    (tmp_path / "pictures").mkdir()
    for row, picture in enumerate(pictures):
        large = cv2.resize(picture[..., ::-1], (160, 120))
        cv2.imwrite(str(tmp_path / f"pictures/{row}.png"), large)
    out, path = tmp_path / "poses.tum", tmp_path / "a.rrd"
    words = [bundle_of_tensors, tmp_path / "pictures", "--out", out, "--rerun", path]
    monkeypatch.setattr(sys, "argv", ["localize.py", *map(str, words)])
    runpy.run_path(str(Path(__file__).parents[2] / "tools/localize.py"), run_name="__main__")
    assert f"{path}: open it with rerun" in capsys.readouterr().out
    told = columns(path)["/world/camera"]
    expected = np.loadtxt(out)
    for row, line in enumerate(expected):
        np.testing.assert_allclose(told["Transform3D:translation"][row][0], line[1:4], atol=1e-6)
        off = Rotation.from_quat(told["Transform3D:quaternion"][row][0]).inv() * Rotation.from_quat(line[4:])
        assert off.magnitude() < 1e-6
    assert sorted(told["time"]) == list(range(COUNT))
