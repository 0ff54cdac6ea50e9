"""Names in other people's files that lead out of their folder: no reader follows one, and nothing is written there."""

import csv
import io
import json
import os
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from mambaloc.data.datasets import cambridge
from mambaloc.data.datasets import capture as capture_scene
from mambaloc.data.download.archives import unpack
from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError
from mambaloc.importing.registry import read_capture
from mambaloc.runtime.bundle import verify_bundle

PICTURE = cv2.imencode(".png", np.zeros((4, 6, 3), np.uint8))[1].tobytes()
PARTS = ("..", ".", "", "inside", "secret.png", "a.png", "...", "~", "C:", "C:secret.png", "%2e%2e", "file:", "a\0b")
LINK = 0o120777 << 16

names = st.builds(
    lambda start, parts, between: start + between.join(parts),
    st.sampled_from(["", "/", "\\", "//", "HERE/"]),
    st.lists(st.sampled_from(PARTS), min_size=1, max_size=5),
    st.sampled_from(["/", "\\", "//", "/./"]),
)


@pytest.fixture
def folder(tmp_path):
    """A folder with an image; beside it lies one that is not of it."""
    (tmp_path / "secret.png").write_bytes(PICTURE)
    (tmp_path / "scene/inside").mkdir(parents=True)
    for name in ("a.png", "inside/a.png"):
        (tmp_path / "scene" / name).write_bytes(PICTURE)
    return tmp_path / "scene"


def frames_csv(folder, name):
    (folder / "scene.json").write_text(json.dumps({capture_scene.VERSION_KEY: capture_scene.VERSION}))
    rows = io.StringIO()
    csv.writer(rows).writerows([capture_scene.COLUMNS, [name, "all", "", *"0001000", "", "train"]])
    (folder / "frames.csv").write_text(rows.getvalue())
    return capture_scene.read_split(folder, "train", BadFrames("skip")).image_paths


def cambridge_labels(folder, name):
    (folder / "dataset_train.txt").write_text(f"\n\n\n{name} 0 0 0 1 0 0 0\n")
    return cambridge.read_split(folder, "train", BadFrames("skip")).image_paths


def transforms_json(folder, name):
    frames = [{"file_path": each, "transform_matrix": np.eye(4).tolist()} for each in (name, "a.png")]
    lens = {"fl_x": 5.0, "fl_y": 5.0, "cx": 3.0, "cy": 2.0, "w": 6, "h": 4}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return read_capture(folder, "nerfstudio").images


def csv_table(folder, name):
    rows = io.StringIO()
    csv.writer(rows).writerows([["image", "x", "y", "z", "qw", "qx", "qy", "qz"], [name, *"0001000"]])
    (folder / "poses.csv").write_text(rows.getvalue())
    return read_capture(folder, "csv_world_from_cam").images


def tum_listing(folder, name):
    (folder / "rgb.txt").write_text(f"1.0 {name}\n2.0 a.png\n")
    (folder / "groundtruth.txt").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    return read_capture(folder, "tum_rgbd").images


def bundle_contract(folder, name):
    (folder / "contract.json").write_text(json.dumps({"files": {name: {"sha256": ""}}, "frames": []}))
    try:
        return verify_bundle(folder)
    except InputError as error:
        path, opened, _ = str(error).partition(": has another sha256")  # whose digest it was told
        if not opened:
            raise
        return [Path(path)]


READERS = (frames_csv, cambridge_labels, transforms_json, csv_table, tum_listing, bundle_contract)


@pytest.mark.parametrize("read", READERS)
def test_no_name_leads_out(read, folder, examples, tally):
    followed = []

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(names)
    @example("../secret.png")
    @example("HERE/../secret.png")
    @example("inside/a.png")
    def attacked(name):
        try:
            found, outcome = read(folder, name.replace("HERE", str(folder))), "nothing outside was read"
        except InputError as error:
            found, outcome = [], "one line" if "\n" not in str(error) else "MORE LINES"
        assert all(os.path.realpath(path).startswith(f"{folder}/") for path in found)
        assert outcome != "MORE LINES"
        followed.extend(found)
        tally(f"{read.__name__}: names that may lead out", outcome)

    attacked()
    assert any(path.parent.name == "inside" for path in followed)  # it does follow names


def everything(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def test_no_member_of_a_zip_leads_out(folder, examples, tally):
    archive = folder.parent / "a.zip"
    archive.touch()
    outside = {path for path in everything(folder.parent) if not path.is_relative_to(folder)}
    written = []

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.lists(st.tuples(names, st.booleans()), min_size=1, max_size=3, unique_by=lambda member: member[0]))
    @example([("../secret.png", False)])
    @example([("way", True), ("way/secret.png", False)])
    @example([("inside/new.png", False)])
    def attacked(members):
        assume(all(name for name, _ in members))
        with zipfile.ZipFile(archive, "w") as opened:
            for name, is_link in members:
                info = zipfile.ZipInfo("x")
                info.filename = name.replace("HERE", str(folder))  # as it is: the constructor would tidy it
                info.external_attr = LINK if is_link else 0
                opened.writestr(info, ".." if is_link else "evil")
        try:
            unpack(archive, folder, limit_bytes=1000)
            outcome = "nothing outside was written"
        except (InputError, OSError):  # the latter, of a name that is a folder's, download() tells in a line
            outcome = "one line"
        found = everything(folder.parent)
        assert {path for path in found if not path.is_relative_to(folder)} == outside
        assert found[folder.parent / "secret.png"] == PICTURE
        assert not any(path.is_symlink() for path in found)
        written.extend(path for path, content in found.items() if content == b"evil")
        tally("zip: members that may lead out", outcome)

    attacked()
    assert written
