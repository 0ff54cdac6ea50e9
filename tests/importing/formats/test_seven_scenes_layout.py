"""Recordings in the layout of 7-Scenes: poses and splits as written, depth beside the images that have it."""

from __future__ import annotations

import numpy as np
import pytest

from mambaloc.importing.registry import read_capture
from mambaloc.rendering import default_intrinsics, smooth_trajectory

INSIDE_M = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))


def test_a_scene_is_read_back(scenes):
    """Against the trajectories that the scene was rendered along."""
    capture = read_capture(scenes / "heads")
    expected = np.concatenate([smooth_trajectory(n, seed, INSIDE_M) for seed, n in ((1, 12), (2, 12), (3, 8))])
    assert (capture.kind, capture.unit, len(capture.images)) == ("7scenes", "metre", 32)
    np.testing.assert_allclose(capture.world_from_cam, expected, atol=1e-8)
    assert capture.split == ("train",) * 24 + ("test",) * 8
    assert dict.fromkeys(capture.sequences) == dict.fromkeys(("seq-01", "seq-02", "seq-03"))
    (camera,) = capture.cameras.values()
    matrix = default_intrinsics((96, 72))
    np.testing.assert_allclose((*camera.focal_px, *camera.center_px), matrix[[0, 1, 0, 1], [0, 1, 2, 2]])
    np.testing.assert_allclose(capture.depth.intrinsics, matrix)
    assert [file.name for file in capture.depth.files[:2]] == ["frame-000000.depth.png", "frame-000001.depth.png"]


def test_depth_may_be_absent(scenes, tmp_path):
    for path in (scenes / "heads").rglob("*"):
        if path.is_file() and not path.name.endswith(".depth.png"):
            target = tmp_path / path.relative_to(scenes / "heads")
            target.parent.mkdir(exist_ok=True)
            target.symlink_to(path)
    assert read_capture(tmp_path).depth is None


@pytest.mark.parametrize(
    ("file", "says"),
    [
        ("seq-01/frame-000000.depth.png", "is not a complete 16-bit PNG"),
        ("camera-intrinsics.txt", "is not a pinhole matrix"),
        ("TrainSplit.txt", "lists no sequence"),
    ],
)
def test_a_damaged_file_is_named(scenes, tmp_path, refused, file, says):
    for path in (scenes / "heads").rglob("*"):
        if path.is_file():
            target = tmp_path / path.relative_to(scenes / "heads")
            target.parent.mkdir(exist_ok=True)
            target.symlink_to(path)
    (tmp_path / file).unlink()
    (tmp_path / file).write_bytes(b"")
    refused(read_capture, tmp_path, file, says)
