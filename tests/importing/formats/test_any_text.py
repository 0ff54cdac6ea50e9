"""A source whose texts were edited elsewhere reads as it did: each format, in each encoding and with each line end."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from test_fuzz import PICTURE, SOURCES

from mambaloc.importing.registry import read_capture

COLMAP = {
    "sparse/0/cameras.txt": "# Camera list\n1 PINHOLE 6 4 5 5 3 2\n",
    "sparse/0/images.txt": "# Image list\n1 1 0 0 0 1 2 3 1 1.png\n\n2 1 0 0 0 1 2 4 1 2.png\n\n",
    "sparse/0/points3D.txt": "# Points\n",
    "images/1.png": PICTURE,
    "images/2.png": PICTURE,
}
FRAMES = [{"file_path": f"{k}.png", "transform_matrix": np.eye(4).tolist()} for k in (1, 2)]
NERFSTUDIO = {"transforms.json": json.dumps({"frames": FRAMES, "fl_x": 5}), "1.png": PICTURE, "2.png": PICTURE}
FILES = {kind: files for kind, (files, _) in SOURCES.items()} | {"colmap": COLMAP, "nerfstudio": NERFSTUDIO}
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-be with a mark")


def written(folder: Path, files: dict[str, str | bytes], encoding: str = "utf-8", ending: str = "\n") -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, str):
            text = content.replace("\n", ending)
            marked = encoding.endswith("mark")
            content = f"\ufeff{text}".encode("utf-16-be") if marked else text.encode(encoding)
        path.write_bytes(content)
    return folder


@pytest.mark.parametrize("kind", sorted(FILES))
def test_texts_of_any_encoding_are_read_alike(kind, tmp_path):
    expected = read_capture(written(tmp_path / "a", FILES[kind]), kind)
    for encoding in ENCODINGS:
        for ending in ("\n", "\r\n"):
            found = read_capture(written(tmp_path / "a", FILES[kind], encoding, ending), kind)
            assert found.images == expected.images, (encoding, ending)
            np.testing.assert_array_equal(found.world_from_cam, expected.world_from_cam)
            assert found.choices == expected.choices
