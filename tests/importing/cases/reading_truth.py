"""The true poses of a real case, and those of an imported scene, read without this library."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

CASES = Path(__file__).parents[3] / "../shared/cases"
needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason="needs ../shared/cases beside the repository")

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


def true_poses(file: Path) -> dict[str, NDArray[np.float64]]:
    """``world_from_cam`` (4, 4) by image, of lines ``image,x,y,z,qw,qx,qy,qz``."""
    with file.open(newline="") as lines:
        return {row["image"]: _matrix(row) for row in csv.DictReader(lines)}


def scene_poses(scene: Path) -> dict[str, NDArray[np.float64]]:
    """``world_from_cam`` (4, 4) of an imported scene in its source's world, by the image's name without folders."""
    world = json.loads((scene / "scene.json").read_text()).get("world", {})
    found = {}
    with (scene / "frames.csv").open(newline="") as lines:
        for row in csv.DictReader(lines):
            pose = _matrix(row)
            pose[:3, 3] += world.get("offset_m", (0, 0, 0))
            name = Path(row["image"]).name
            assert name not in found
            found[name] = pose
    return found


def assert_true(
    found: dict[str, NDArray[np.float64]], truth: dict[str, NDArray[np.float64]], atol: float = 2e-6
) -> None:
    """Whether each image of the truth has its pose, and no other image has one."""
    assert set(found) == set(truth)
    for name, pose in truth.items():
        np.testing.assert_allclose(found[name], pose, atol=atol, err_msg=name)


def _matrix(row: dict[str, str]) -> NDArray[np.float64]:
    x, y, z, *xyzw = (float(row[name]) for name in POSE)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(xyzw).as_matrix(), (x, y, z)
    return pose
