"""What tests of importing are made of: captures without images, and one whose lens is known."""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mambaloc.importing.capture import Capture

_TOOL = Path(__file__).parents[2] / "tools" / "import_scene.py"

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
SIZE = (160, 120)
FOCAL_PX = 140.0
LENS = {"k1": -0.12, "k2": 0.03, "p1": 0.002, "p2": -0.001}


@dataclass
class Rendered:
    """A capture of the embedded room as ``transforms.json`` has it, taken through a lens that is known."""

    folder: Path
    world_from_cam: NDArray[np.float64]
    matrix: NDArray[np.float64]
    coefficients: NDArray[np.float64]

    def edit(self, change: Callable[[dict], None]) -> None:
        file = self.folder / "transforms.json"
        told = json.loads(file.read_text())
        change(told)
        file.write_text(json.dumps(told))


def tool(*words: object) -> None:
    """Run ``tools/import_scene.py`` in this process, which has imported what it needs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["tools/import_scene.py", *map(str, words)])
        runpy.run_path(str(_TOOL), run_name="__main__")


def told(folder: Path) -> dict[str, Any]:
    """What the ``scene.json`` of an imported scene says."""
    return json.loads((folder / "scene.json").read_text())


def capture_of(world_from_cam: NDArray[np.float64], **told) -> Capture:
    """A capture without images."""
    count = len(world_from_cam)
    values = {
        "kind": "test",
        "images": tuple(Path(f"{row:04d}.png") for row in range(count)),
        "sequences": ("one",) * count,
        "unit": "metre",
        "choices": {},
        **told,
    }
    return Capture(world_from_cam=world_from_cam, **values)


def poses_at(position: NDArray[np.float64], yaw_deg: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
    """Upright cameras in a world whose z is up, that look along x where their yaw is 0."""
    position = np.asarray(position, dtype=float)
    level = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    poses = np.tile(np.eye(4), (len(position), 1, 1))
    turns = Rotation.from_euler("z", np.broadcast_to(yaw_deg, len(position))[:, None], degrees=True).as_matrix()
    poses[:, :3, :3] = turns @ level
    poses[:, :3, 3] = position
    return poses


def line(count: int, step: float = 0.1) -> NDArray[np.float64]:
    """Positions along x."""
    return np.stack((step * np.arange(count), np.zeros(count), np.zeros(count)), axis=1)
