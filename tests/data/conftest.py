"""Tiny scenes written by hand: every image is one colour that says which frame it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

SIZE = (32, 24)  # width and height of the images


@dataclass
class TinyScene:
    """A written scene, and what was written: frames in reading order, which is also each one's id in its image."""

    folder: Path
    images: list[Path] = field(default_factory=list)
    world_from_cam: list[NDArray[np.float64]] = field(default_factory=list)
    by_sequence: dict[str, list[int]] = field(default_factory=dict)

    def position_m(self, ids: list[int]) -> NDArray[np.float64]:
        return np.stack([self.world_from_cam[i][:3, 3] for i in ids])

    def quaternion(self, ids: list[int]) -> NDArray[np.float64]:
        rotations = Rotation.from_matrix([self.world_from_cam[i][:3, :3] for i in ids])
        return rotations.as_quat(canonical=True)[:, [3, 0, 1, 2]]


def picture(number: int) -> NDArray[np.uint8]:
    """One colour, BGR as OpenCV writes it: red is the frame's id, green tells red from blue, blue is 255 - id."""
    return np.full((SIZE[1], SIZE[0], 3), (255 - number, 128, number), np.uint8)


@pytest.fixture
def write_tiny_scene(tmp_path: Path) -> Callable[..., TinyScene]:
    """Write a scene in the 7-Scenes layout; ``sequences`` gives the frames of each."""

    def write(sequences: dict[int, int], test: tuple[int, ...] = (), kind: str = "png", name: str = "den") -> TinyScene:
        scene = TinyScene(tmp_path / "scenes" / name)
        rng = np.random.default_rng(7)
        for number, length in sequences.items():
            folder = scene.folder / f"seq-{number:02d}"
            folder.mkdir(parents=True)
            for frame in range(length):
                pose = np.eye(4)
                pose[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
                pose[:3, 3] = rng.uniform(-3, 3, 3)
                image = folder / f"frame-{frame:06d}.color.{kind}"
                cv2.imwrite(str(image), picture(len(scene.images)))
                np.savetxt(folder / f"frame-{frame:06d}.pose.txt", pose, delimiter="\t")
                scene.by_sequence.setdefault(folder.name, []).append(len(scene.images))
                scene.images.append(image)
                scene.world_from_cam.append(pose)
        for file, numbers in (("TrainSplit", set(sequences) - set(test)), ("TestSplit", set(test))):
            (scene.folder / f"{file}.txt").write_text("".join(f"sequence{n}\n" for n in sorted(numbers)))
        return scene

    return write


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The real data beside the repository."""
    folder = Path(__file__).parents[3] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}")
    return folder
