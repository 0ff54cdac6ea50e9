"""A lens from the capture to the query: images as the camera stores them are localized as the scene's own are."""

from __future__ import annotations

import json
import runpy
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import LENS, SIZE, told
from scipy.spatial.transform import Rotation

from mambaloc.data import PoseDataModule
from mambaloc.data.cameras import undistortion_of
from mambaloc.errors import InputError
from mambaloc.images import read_image
from mambaloc.mapping import MapSettings, build_map
from mambaloc.mapping.posed import read_frames
from mambaloc.mapping.recipe import recipe_of
from mambaloc.runtime.camera_models import OpenCVModel
from mambaloc.runtime.localizer import Localizer
from mambaloc.runtime.maps import SparseMap
from mambaloc.runtime.undistortion import Undistortion

TOOLS = Path(__file__).parents[2] / "tools"
QUERIES = range(2, 40, 5)  # frames of 40


@pytest.fixture(scope="session")
def mapped(imported_once, shared_folder) -> Path:
    """The file of a map of the scene's training frames."""

    def make(folder: Path) -> None:
        train = read_frames(recipe_of(imported_once), "train")
        build_map(train, MapSettings(width=SIZE[0]), "room").save(folder / "map.safetensors")

    return shared_folder("map with a lens", make) / "map.safetensors"


@pytest.fixture(scope="session")
def queries(rendered_once, imported_once, shared_folder) -> Path:
    """``stored/``, ``copies/`` without distortion, and ``larger/``: the stored ones at twice their size."""

    def make(folder: Path) -> None:
        for name in ("stored", "copies", "larger"):
            (folder / name).mkdir()
        for row in QUERIES:
            name = f"{row + 1:04d}.png"
            shutil.copy(rendered_once.folder / "images" / name, folder / "stored")
            shutil.copy(imported_once / "images/images" / name, folder / "copies")
            twice = cv2.resize(cv2.imread(str(folder / "stored" / name)), None, fx=2, fy=2)
            cv2.imwrite(str(folder / "larger" / name), twice)

    return shared_folder("queries of a lens", make)


def localize(*words: object) -> None:
    run_tool("localize", *words)


def run_tool(name: str, *words: object) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [f"tools/{name}.py", *map(str, words)])
        runpy.run_path(str(TOOLS / f"{name}.py"), run_name="__main__")


# --- the scene -------------------------------------------------------------------------------------------------------


def test_a_scene_keeps_the_lens_of_its_camera(imported_once, rendered_once):
    found = undistortion_of(imported_once)
    (camera,) = told(imported_once)["cameras"].values()
    assert found.stored == SIZE
    assert isinstance(found.lens, OpenCVModel)
    assert found.lens.coefficients == (LENS["k1"], LENS["k2"], LENS["p1"], LENS["p2"], 0.0)
    np.testing.assert_allclose(found.lens.focal_px, rendered_once.matrix[[0, 1], [0, 1]])
    np.testing.assert_allclose(found.lens.center_px, rendered_once.matrix[:2, 2])
    assert found.leaves.size == (camera["width"], camera["height"])
    assert list(found.leaves.focal_px) == camera["focal_px"]
    assert PoseDataModule(scene=str(imported_once), image_size=64, short_side=96).undistortion == found


def test_a_query_is_undistorted_as_the_training_pictures_were(queries, imported_once):
    """To the last bit: it is one function."""
    for stored in (queries / "stored").iterdir():
        found, intrinsics = undistortion_of(imported_once).apply(read_image(stored), "room")
        np.testing.assert_array_equal(found, read_image(queries / "copies" / stored.name))
        (camera,) = told(imported_once)["cameras"].values()
        np.testing.assert_array_equal(np.diag(intrinsics)[:2], camera["focal_px"])


@pytest.fixture
def changed(imported_once, tmp_path):
    """``changed(change)``: what is known of a scene's lens once its ``scene.json`` is changed."""
    folder = tmp_path / "changed"
    folder.mkdir()
    shutil.copy(imported_once / "frames.csv", folder)

    def changed(change) -> Undistortion:
        note = told(imported_once)
        change(note["cameras"])
        (folder / "scene.json").write_text(json.dumps(note))
        return undistortion_of(folder)

    return changed


def of_before(cameras):
    for camera in cameras.values():  # as it was written before lenses were kept
        camera["lens"] = {key: camera["lens"][key] for key in ("model", "focal_px", "centre_px")}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (of_before, "none was kept with it"),
        (lambda cameras: [camera.pop("lens") for camera in cameras.values()], "as those of a pinhole"),
        (
            lambda cameras: [camera.update(adjusted_from="a") for camera in cameras.values()],
            "length was adjusted",
        ),
        (lambda cameras: cameras.clear(), "does not describe their camera"),
        (
            lambda cameras: [camera["lens"].update(opencv=None, unknown="FOV") for camera in cameras.values()],
            "FOV",
        ),
    ],
)
def test_why_a_lens_is_not_known(changed, change, says):
    found = changed(change)
    assert found.lens is None
    assert says in found.unknown


def test_of_two_cameras_no_lens_is_taken(changed, tmp_path):
    file = tmp_path / "changed/frames.csv"
    lines = file.read_text().splitlines()
    row = next(at for at, line in enumerate(lines) if line.endswith(",train"))
    lines[row] = lines[row].replace(",camera-1,", ",camera-2,")
    file.write_text("\n".join(lines) + "\n")
    assert changed(lambda cameras: None).unknown == "they are of 2 cameras"


def test_a_scene_that_was_not_imported_has_none(tmp_path):
    assert undistortion_of(tmp_path).unknown == "their scene was not imported"


@pytest.mark.parametrize("wrong", [{"coefficients": [1]}, {"opencv": "x"}, {"focal_px": 3}, {"width": -1}])
def test_a_damaged_lens_names_the_file(changed, wrong):
    with pytest.raises(InputError, match=r"scene\.json: lens: .*import the scene again") as caught:
        changed(lambda cameras: [camera["lens"].update(wrong) for camera in cameras.values()])
    assert "\n" not in str(caught.value)


# --- the map and the tool --------------------------------------------------------------------------------------------


def test_a_map_keeps_the_lens(mapped, imported_once):
    assert SparseMap.load(mapped).undistortion == undistortion_of(imported_once)


def test_an_older_map_knows_none(mapped, tmp_path):
    data = mapped.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    about = json.loads(header["__metadata__"]["about"])
    del about["undistortion"]
    header["__metadata__"]["about"] = json.dumps(about)
    told = json.dumps(header).encode()
    (tmp_path / "map.safetensors").write_bytes(len(told).to_bytes(8, "little") + told + data[8 + length :])
    assert SparseMap.load(tmp_path / "map.safetensors").undistortion == Undistortion()


def test_stored_pictures_get_the_poses_of_the_copies(mapped, queries, rendered_once, tmp_path):
    """Guess: the same to the last digit, 1 cm off the truth; taken for a pinhole's, several times that.

    Found: 2 mm off (median; at worst 13 mm); without undistortion two of eight are lost, the others 14 mm off.
    """
    poses = {}
    for name, words in (("copies", ()), ("stored", ("--distorted",)), ("larger", ("--distorted",))):
        localize(mapped, queries / name, "--out", tmp_path / f"{name}.tum", *words)
        poses[name] = np.loadtxt(tmp_path / f"{name}.tum")[:, 1:]
    np.testing.assert_allclose(poses["stored"], poses["copies"], atol=1e-9)
    truth = rendered_once.world_from_cam[list(QUERIES)]
    off_m = {}
    for name, (position_m, turn_deg) in {"stored": (0.02, 0.5), "larger": (0.03, 0.75)}.items():
        off_m[name] = np.linalg.norm(poses[name][:, :3] - truth[:, :3, 3], axis=1)
        off = Rotation.from_quat(poses[name][:, 3:]).inv() * Rotation.from_matrix(truth[:, :3, :3])
        assert off_m[name].max() < position_m
        assert np.degrees(off.magnitude()).max() < turn_deg
    localizer = Localizer(mapped)
    wrong = [localizer.localize(path).position_m for path in sorted((queries / "stored").iterdir())]
    off_m["wrong"] = np.linalg.norm(wrong - truth[:, :3, 3], axis=1)
    assert np.nanmedian(off_m["wrong"]) > 3 * np.median(off_m["stored"])


def test_stored_pictures_are_added_to_a_map_as_their_copies_are(mapped, queries, tmp_path):
    """Guess: the same map, to the last digit."""
    grown = {}
    for name, words in (("copies", ()), ("stored", ("--distorted",))):
        out = tmp_path / name
        run_tool("map", mapped, "--add", queries / name, "--name", "more", "--out", out, *words)
        grown[name] = SparseMap.load(out / "map.safetensors")
    assert grown["stored"].sessions["more"] > 0
    for array in ("points_m", "descriptors", "views", "key_poses"):
        np.testing.assert_array_equal(getattr(grown["stored"], array), getattr(grown["copies"], array))


@pytest.mark.parametrize(("words", "query"), [((), "?distorted=true"), (("--distorted",), "")])
def test_a_server_answers_stored_pictures_as_their_copies(mapped, queries, words, query):
    """Guess: the same to the last digit; a request's own word counts before the server's."""
    first = sorted((queries / "stored").iterdir())[0]
    with served(mapped, *words) as url:
        copy = ask(f"{url}?distorted=false", queries / "copies" / first.name)
        assert copy["is_accepted"]
        for key in ("position_m", "quaternion_wxyz", "covariance"):
            assert ask(f"{url}{query}", first)[key] == copy[key]
        assert "give true or false" in ask(f"{url}?distorted=1", first)["error"]
        both = ask(f"{url}?distorted=true&intrinsics=140,140,80,60", first)["error"]
        assert "Leave out one" in both


@contextmanager
def served(model: Path, *words: str):
    """The address of a server."""
    serve = [sys.executable, "-c", "from mambaloc.commands.serve import main; main()"]
    command = [*serve, str(model), "--port", "0", "--workers", "1", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        url = process.stdout.readline().split(" ")[0]
        process.stdout.readline()
        try:
            for _ in range(300):
                try:
                    urllib.request.urlopen(url.split("/localize")[0] + "/health", timeout=5)
                    break
                except OSError:
                    time.sleep(0.1)
            yield url
        finally:
            process.send_signal(signal.SIGINT)


def ask(url: str, picture: Path) -> dict:
    try:
        with urllib.request.urlopen(url, picture.read_bytes(), timeout=60) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as error:
        return json.load(error)


def test_wrong_uses_of_distorted_with_a_map_end_in_one_line(
    mapped, map_of_den, queries, imported_once, tmp_path, capsys
):
    for words, says in (
        ((map_of_den, "--add", queries / "stored"), "the lens of its images is not known"),
        ((mapped, "--add", imported_once), "a scene's images have no distortion. Leave out --distorted."),
        ((mapped,), "--distorted: applies to --add alone. Leave it out."),
        ((mapped, "--add", queries / "stored", "--intrinsics", "140,140,80,60"), "not allowed with"),
    ):
        with pytest.raises(SystemExit) as ended:
            run_tool("map", *words, "--distorted", "--out", tmp_path / "grown")
        assert ended.value.code == 2
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert line.startswith("error: ")
        assert says in line
    assert not (tmp_path / "grown").exists()


def test_wrong_uses_end_in_one_line(mapped, map_of_den, queries, tmp_path, capsys):
    narrow = tmp_path / "narrow.png"
    cv2.imwrite(str(narrow), np.zeros((90, 160, 3), np.uint8))
    for words, says in (
        ((map_of_den, queries / "stored"), "the lens of its images is not known (their scene was not imported)"),
        ((mapped, narrow), "an image of 160x90 has another shape than 160x120"),
        ((mapped, queries / "stored", "--intrinsics", "140,140,80,60"), "not allowed with"),
    ):
        with pytest.raises(SystemExit) as ended:
            localize(*words, "--distorted", "--out", tmp_path / "poses.tum")
        assert ended.value.code == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert line.startswith("error: ")
        assert says in line
    assert not (tmp_path / "poses.tum").exists()
