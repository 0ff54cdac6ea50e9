"""Captures as they really are: frames that are missing, far off, turned or of another shape."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import SIZE, told, tool

from mambaloc.data.datasets.capture import read_rows, read_split
from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError
from mambaloc.images import read_image
from mambaloc.importing.capture import Camera
from mambaloc.importing.importer import import_scene
from mambaloc.importing.registry import FORMATS, Format, read_capture
from mambaloc.importing.undistort.images import selected, write_images


def test_bad_frames_are_left_out_and_named(rendered, tmp_path):
    def spoil(said):
        said["frames"][3]["transform_matrix"][0][3] = math.nan
        said["frames"].append({**said["frames"][0], "file_path": "images/0041.png"})

    rendered.edit(spoil)
    cut, small = rendered.folder / "images/0008.png", rendered.folder / "images/0011.png"
    content = cut.read_bytes()
    cut.unlink(), cut.write_bytes(content[: len(content) // 2])
    small.unlink(), cv2.imwrite(str(small), np.zeros((30, 50, 3), np.uint8))
    imported = import_scene(rendered.folder, tmp_path / "a")
    assert {Path(file).name: rule for file, rule in imported.left_out.items()} == {
        "0004.png": "no fix: the pose is NaN, infinite or all zeros",
        "0008.png": "image is truncated",
        "0011.png": "image is 50x30, of another shape than its camera's 160x120",
    }
    said = told(tmp_path / "a")
    assert said["frames"]["used"] == 37
    assert said["frames"]["poses_without_image"] == 1
    assert said["sanity"]["verdict"].startswith("usable, but 3 of 40 frames are left out")
    assert "0008.png | image is truncated" in (tmp_path / "a/report.md").read_text()


def test_a_frame_too_far_to_be_read_back_is_left_out(rendered, tmp_path):
    def move(said):
        said["frames"][3]["transform_matrix"][1][3] = -1.1e7

    rendered.edit(move)
    imported = import_scene(rendered.folder, tmp_path / "a")
    assert {Path(file).name: rule for file, rule in imported.left_out.items()} == {
        "0004.png": "the position is 1.1e+07 from the middle of the others, over 1000 times their spread"
    }
    assert len(read_rows(tmp_path / "a")) == 39


def test_images_of_another_shape_are_used_and_named(rendered, tmp_path):
    rendered.edit(
        lambda said: [said.pop(key) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2")]
    )
    for number in (5, 6):
        path = rendered.folder / f"images/{number:04d}.png"
        path.unlink(), cv2.imwrite(str(path), np.zeros((160, 120, 3), np.uint8))
    import_scene(rendered.folder, tmp_path / "a")
    rows = {row.image.name: row.split for row in read_rows(tmp_path / "a")}
    assert {"0005.png", "0006.png"} <= rows.keys()
    assert "2 images are shaped otherwise" in told(tmp_path / "a")["sanity"]["verdict"]


def test_too_few_frames_are_written_as_not_usable_and_refused(rendered, tmp_path, capsys):
    rendered.edit(lambda said: said.update(frames=said["frames"][:12]))
    with pytest.raises(SystemExit) as exit_:
        tool(rendered.folder, "--out", tmp_path / "a")
    assert exit_.value.code == 2
    error = capsys.readouterr().err.strip()
    assert "not usable: 12 usable frames, and 20 are needed" in error
    assert len(error.splitlines()) == 1
    assert "**not usable:**" in (tmp_path / "a/report.md").read_text()
    with pytest.raises(InputError, match="was found not usable: 12 usable frames"):
        read_split(tmp_path / "a", "train", BadFrames())


def test_files_are_copied_where_nothing_is_to_be_done(rendered, tmp_path):
    rendered.edit(lambda said: said.update(k1=0, k2=0, p1=0, p2=0))
    import_scene(rendered.folder, tmp_path / "a")
    for image in (rendered.folder / "images").iterdir():
        assert (tmp_path / "a/images/images" / image.name).read_bytes() == image.read_bytes()
    (camera,) = told(tmp_path / "a")["cameras"].values()
    assert camera["images"] == "as they were: the camera is a pinhole"


EXIF_TURNED = (
    b"Exif\x00\x00II*\x00\x08\x00\x00\x00\x01\x00\x12\x01\x03\x00\x01\x00\x00\x00\x06\x00\x00\x00\x00\x00\x00\x00"
)


@pytest.mark.parametrize("size", [SIZE, SIZE[::-1]], ids=["as stored", "upright"])
def test_a_photograph_with_exif_is_turned_as_its_camera_has_it(rendered_once, tmp_path, size):
    """Structure from motion may have seen it either way; the camera's size says which."""
    capture = selected(read_capture(rendered_once.folder), [0])
    coarse = np.random.default_rng(1).integers(0, 256, (3, 4, 3), dtype=np.uint8)
    stored = cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC)
    jpeg = cv2.imencode(".jpg", stored[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    segment = b"\xff\xe1" + (len(EXIF_TURNED) + 2).to_bytes(2, "big") + EXIF_TURNED
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:])
    camera = Camera(*size, (140.0, 140.0), (size[0] / 2, size[1] / 2))
    capture = replace(capture, images=(tmp_path / "a.jpg",), cameras={"camera-1": camera})
    written, sizes, rules, *_ = write_images(capture, tmp_path / "out")
    assert rules == {}
    assert sizes == [size]
    expected = stored if size == SIZE else np.rot90(stored, k=-1)
    assert np.abs(read_image(written.images[0]).astype(float) - expected).mean() < 3


def test_names_are_made_safe_and_unique(rendered_once, tmp_path):
    capture = selected(read_capture(rendered_once.folder), [0, 1, 2, 3])
    names = ("../../up", "../../up", "a b/c", "a_b c")
    capture = replace(capture, sequences=names, images=(capture.images[0], capture.images[0], *capture.images[2:]))
    written, *_ = write_images(capture, tmp_path / "out")
    found = [path.relative_to(tmp_path / "out").as_posix() for path in written.images]
    assert found == [
        "images/up/0001.png", "images/up/0001-1.png", "images/a_b_c/0003.png", "images/a_b_c-2/0004.png",
    ]  # fmt: skip


def test_a_source_that_breaks_leaves_nothing(rendered, tmp_path, monkeypatch):
    monkeypatch.setattr("mambaloc.importing.importer.write_frames", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        import_scene(rendered.folder, tmp_path / "out" / "a")
    assert list((tmp_path / "out").iterdir()) == []


def test_the_first_format_that_matches_is_taken(rendered_once, monkeypatch):
    other = Format("anything", lambda source: True, lambda source: "read")
    monkeypatch.setattr("mambaloc.importing.registry.FORMATS", {"other": other, **FORMATS})
    assert read_capture(rendered_once.folder) == "read"
    assert read_capture(rendered_once.folder, "nerfstudio").kind == "nerfstudio"
