"""Captures made by hand and by the renderer: poses that are known, and images that are right for them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import FLIP, FOCAL_PX, LENS, SIZE, Rendered
from recorded import Recording, record

from mambaloc.errors import InputError
from mambaloc.importing.capture import Capture
from mambaloc.importing.importer import import_scene
from mambaloc.rendering import Room, embedded_room, embedded_walk, render


@pytest.fixture(scope="session")
def room() -> Room:
    """The embedded room."""
    return embedded_room()


@pytest.fixture(scope="session")
def rendered_once(shared_folder, request) -> Rendered:
    """Forty frames of a walk, distorted by OpenCV's own inverse of the lens; read only."""
    walk = embedded_walk(40, seed=3, start_deg=20.0, step_deg=2.4)
    center = ((SIZE[0] - 1) / 2 + 1.5, (SIZE[1] - 1) / 2 - 1.0)
    matrix = np.array([[FOCAL_PX, 0, center[0]], [0, FOCAL_PX, center[1]], [0, 0, 1]])
    coefficients = np.array([*LENS.values()])

    def make(folder: Path) -> None:
        _write_rendered(request.getfixturevalue("room"), Rendered(folder, walk, matrix, coefficients))

    return Rendered(shared_folder("rendered", make), walk, matrix, coefficients)


@pytest.fixture(scope="session")
def imported_once(rendered_once, shared_folder) -> Path:
    """The same as a scene's folder; read only."""

    def make(folder: Path) -> None:
        import_scene(rendered_once.folder, folder / "room", command="python tools/import_scene.py room")

    return shared_folder("imported", make) / "room"


def _write_rendered(room: Room, rendered: Rendered) -> None:
    """Render what each pixel of the distorted images sees, and list the images in ``transforms.json``."""
    (rendered.folder / "images").mkdir()
    columns, rows = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    pixels = np.stack((columns, rows), axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, rendered.matrix, rendered.coefficients).reshape(SIZE[1], SIZE[0], 2)
    wide = np.array([[1.5 * FOCAL_PX, 0, SIZE[0]], [0, 1.5 * FOCAL_PX, SIZE[1]], [0, 0, 1]])
    where = (rays * 1.5 * FOCAL_PX + SIZE).astype(np.float32)
    frames = []
    for number, world_from_cam in enumerate(rendered.world_from_cam, start=1):
        rgb, _ = render(room, wide, world_from_cam, (2 * SIZE[0], 2 * SIZE[1]))
        seen = cv2.remap(rgb, where[..., 0], where[..., 1], cv2.INTER_LINEAR)
        cv2.imwrite(str(rendered.folder / f"images/{number:04d}.png"), seen[..., ::-1])
        pose = (world_from_cam @ FLIP).tolist()
        frames.append({"file_path": f"images/{number:04d}.png", "transform_matrix": pose})
    told = {
        "fl_x": FOCAL_PX, "fl_y": FOCAL_PX, "cx": rendered.matrix[0, 2] + 0.5, "cy": rendered.matrix[1, 2] + 0.5,
        "w": SIZE[0], "h": SIZE[1], **LENS, "camera_model": "OPENCV", "frames": frames,
    }  # fmt: skip
    (rendered.folder / "transforms.json").write_text(json.dumps(told))


@pytest.fixture
def rendered(rendered_once, tmp_path) -> Rendered:
    """The same, in a folder that a test may change."""
    folder = tmp_path / "room"
    (folder / "images").mkdir(parents=True)
    (folder / "transforms.json").write_bytes((rendered_once.folder / "transforms.json").read_bytes())
    for image in (rendered_once.folder / "images").iterdir():
        (folder / "images" / image.name).symlink_to(image)
    return Rendered(folder, rendered_once.world_from_cam, rendered_once.matrix, rendered_once.coefficients)


@pytest.fixture(scope="session")
def recording() -> Recording:
    return record()


@pytest.fixture
def refused() -> Callable[..., str]:
    """Check that reading ends in one line that says all of some words; return it."""

    def refused(read: Callable[[Path], Capture], source: Path, *says: str) -> str:
        with pytest.raises(InputError) as caught:
            read(source)
        message = str(caught.value)
        assert "\n" not in message
        for words in says:
            assert words in message, message
        return message

    return refused
