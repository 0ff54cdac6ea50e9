"""Captures that users had trouble with, ``../shared/cases/NAME``, and their true poses."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

CASES = Path(__file__).parents[4] / "shared" / "cases"

needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason="needs ../shared/cases beside the repository")


def truth_of(name: str) -> dict[str, NDArray[np.float64]]:
    """``world_from_cam`` (4, 4) of each image by its name, OpenCV camera axes, as ``truth.txt`` has them."""
    found = {}
    with (CASES / name / "truth.txt").open() as file:
        for row in csv.DictReader(file):
            pose = np.eye(4)
            pose[:3, 3] = [float(row[axis]) for axis in "xyz"]
            pose[:3, :3] = Rotation.from_quat([float(row[f"q{each}"]) for each in "xyzw"]).as_matrix()
            found[row["image"]] = pose
    return found


def assert_true(name: str, images: Iterable[Path], world_from_cam: NDArray[np.float64], within: float = 1e-6) -> None:
    """Check that images have their true poses, whose positions are written to a millionth."""
    truth = truth_of(name)
    for image, pose in zip(images, world_from_cam, strict=True):
        np.testing.assert_allclose(pose, truth[image.name], rtol=0, atol=within, err_msg=image.name)
