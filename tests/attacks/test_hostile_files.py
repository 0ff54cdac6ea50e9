"""Every parser is fed damaged files: it reads them or says in one line what is wrong, and nothing else happens.

A damaged file is a whole one after a few accidents: cut off, bytes changed, a piece taken out or said twice, a number
replaced by one that no file should hold.
"""

import json
import shutil
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mambaloc.benchmark import BenchmarkConfig
from mambaloc.cli import recipe_arguments
from mambaloc.data.cameras import known_cameras, known_or_assumed_cameras
from mambaloc.data.datasets import cambridge, seven_scenes
from mambaloc.data.datasets import capture as capture_scene
from mambaloc.data.download import download
from mambaloc.data.frames import BadFrames
from mambaloc.data.points import read_points
from mambaloc.errors import InputError, InputWarning
from mambaloc.images import decode_image
from mambaloc.importing.importer import import_scene
from mambaloc.importing.registry import read_capture
from mambaloc.models.weights import read_checkpoint
from mambaloc.rendering import frames_of_sequences, read_pose_table, write_cambridge
from mambaloc.rendering.trajectories import smooth_trajectory
from mambaloc.runtime import Contract, Localizer
from mambaloc.runtime.bundle import verify_bundle
from mambaloc.sweep import Store, Trial, read_sweep
from mambaloc.zoo.loading import load_released
from mambaloc.zoo.manifest import Manifest

REPOSITORY = Path(__file__).parents[2]
RELEASED = REPOSITORY / "zoo/student.embedded_room"
STRANGE = [
    b"nan",
    b"inf",
    b"-1",
    b"1e999",
    b"99999999999999999999",
    b"",
    b"\0",
    b"../../x",
    b"{}",
    b"[[[[",
    b"\xff\xfe",
]


LAUGHS = "\n".join(["a0: &a0 [x]", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12))])
POSES = "scene,split,image,x,y,z,qw,qx,qy,qz\n"


@st.composite
def damages(draw) -> Callable[[bytes], bytes]:
    """One to three accidents, each at some share of a file's length."""
    accidents = draw(
        st.lists(
            st.tuples(
                st.sampled_from(["cut", "change", "remove", "repeat", "number"]),
                st.floats(0, 1),
                st.integers(1, 64),
                st.sampled_from(STRANGE),
                st.binary(min_size=1, max_size=4),
            ),
            min_size=1,
            max_size=3,
        )
    )

    def damage(data: bytes) -> bytes:
        for how, where, length, strange, noise in accidents:
            at = int(where * len(data))
            if how == "cut":
                data = data[:at]
            elif how == "change":
                data = data[:at] + noise + data[at + len(noise) :]
            elif how == "remove":
                data = data[:at] + data[at + length :]
            elif how == "repeat":
                data = data[:at] + data[at : at + length] * 2 + data[at + length :]
            else:  # in place of a word
                start = max(data.rfind(white, 0, at) for white in (b" ", b"\n", b",", b":")) + 1
                ends = [end for white in (b" ", b"\n", b",", b":") if (end := data.find(white, at)) != -1]
                data = data[:start] + strange + data[min(ends, default=len(data)) :]
        return data

    return damage


def _overlaid(folder: Path) -> BenchmarkConfig:
    return BenchmarkConfig("mambaloc").with_overlay(folder / "overlay.yaml")


@pytest.fixture(scope="module")
def frames_7scenes(tmp_path_factory, scenes):
    folder = shutil.copytree(scenes / "heads", tmp_path_factory.mktemp("hostile") / "heads")
    return folder, [folder / "TrainSplit.txt", folder / "seq-01/frame-000000.pose.txt"]


@pytest.fixture
def fed(examples, tally):
    """Feed a parser one whole file with damages."""

    def feed(name: str, parse: Callable[[Path], object], target: Path, most: int = examples) -> None:
        whole = target.read_bytes()
        parse(target)  # what is damaged is a whole file

        @settings(max_examples=most, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
        @given(damages())
        def attacked(damage):
            target.write_bytes(damage(whole))
            try:
                parse(target)
                outcome = "harmless, read"
            except InputError as error:
                outcome = "one line" if "\n" not in str(error) else "MORE LINES"
            tally(f"{name}: damaged", outcome)
            assert outcome != "MORE LINES"

        try:
            attacked()
        finally:
            target.write_bytes(whole)

    return feed


@pytest.mark.parametrize("which", [0, 1], ids=["split", "pose"])
def test_7scenes(which, frames_7scenes, fed):
    folder, files = frames_7scenes
    fed(f"7-Scenes {files[which].name}", lambda _: seven_scenes.read_split(folder, "train", BadFrames()), files[which])


def test_cambridge(tmp_path, fed):
    lines = [f"seq1/frame{n:05d}.png {n} 2.5 -3 0.5 0.5 0.5 0.5" for n in range(4)]
    for n in range(4):
        (tmp_path / f"seq1/frame{n:05d}.png").parent.mkdir(exist_ok=True)
        (tmp_path / f"seq1/frame{n:05d}.png").touch()
    labels = tmp_path / "dataset_train.txt"
    labels.write_text(
        "\n".join(["Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", "", *lines])
    )
    fed("Cambridge labels", lambda _: cambridge.read_split(tmp_path, "train", BadFrames()), labels)


def test_pose_table(tmp_path, fed):
    table = tmp_path / "poses.csv"
    rows = [f"heads,train,seq-01/frame-{n:06d}.color.png,{n},0.5,1,1,0,0,0" for n in range(4)]
    table.write_text("\n".join(["scene,split,image,x,y,z,qw,qx,qy,qz", *rows]))
    fed("pose table", lambda path: read_pose_table(path, "heads", "7scenes"), table)


def test_points_of_a_model(tmp_path, fed):
    walks = {n: smooth_trajectory(4, n, ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))) for n in (1, 2)}
    shots = frames_of_sequences(walks, test=(2,), image="seq{sequence}/frame{frame:05d}.png")
    folder = write_cambridge(tmp_path, "Yard", shots, size=(48, 36), points=True)
    frames = cambridge.read_split(folder, "train", BadFrames())
    cameras = known_cameras("cambridge", folder, frames)
    fed("NVM model", lambda path: read_points(path.parent, frames, cameras, 20, seed=0), folder / "reconstruction.nvm")


@pytest.mark.parametrize("name", ["frames.csv", "scene.json"])
def test_imported_scenes(name, captured, tmp_path, fed):
    folder = tmp_path / "scene"
    import_scene(captured, folder, split="block")

    def parse(_: Path) -> None:
        frames = capture_scene.read_split(folder, "train", BadFrames())
        with warnings.catch_warnings(action="ignore", category=InputWarning):
            known_or_assumed_cameras("capture", folder, frames)
        capture_scene.describe_capture(folder)

    fed(f"imported scene's {name}", parse, folder / name)


@pytest.fixture
def captured(scenes, tmp_path):
    """Frames of the scene as nerfstudio has them: another camera's axes, the same centres."""
    folder = shutil.copytree(scenes / "heads", tmp_path / "captured")
    frames = []
    for file in sorted(folder.glob("seq-0[12]/*.pose.txt")):
        pose = [[float(word) for word in line.split()] for line in file.read_text().splitlines() if line.strip()]
        axes = [[x, -y, -z, at] for x, y, z, at in pose]
        picture = file.relative_to(folder).as_posix().replace("pose.txt", "color.png")
        frames.append({"file_path": picture, "transform_matrix": axes})
    lens = {"fl_x": 80.0, "fl_y": 80.0, "cx": 48.0, "cy": 36.0, "w": 96, "h": 72}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def test_transforms(captured, fed):
    fed("transforms.json", lambda path: read_capture(path.parent, "nerfstudio"), captured / "transforms.json")


def test_stores(tmp_path, fed):
    with Store(tmp_path) as store:
        for number in range(3):
            cell = Trial({"system": "a", "seed": str(number)}, ("recipe.yaml",), str(number) * 64)
            store.write(cell, {"last": {"metrics": {"position_error_m": 0.5}}}, 1.0)
    fed("store of results", lambda path: Store.ended(path.parent), tmp_path / "results.sqlite")


def test_archives(scenes, tmp_path, fed):
    with zipfile.ZipFile(tmp_path / "heads.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("TrainSplit.txt", "TestSplit.txt", "seq-01/frame-000000.pose.txt"):
            archive.write(scenes / "heads" / name, name)

    def parse(path: Path) -> None:
        shutil.rmtree(path.with_suffix(""), ignore_errors=True)
        download("7scenes", "heads", path.parent, accept_changed=True)

    fed("downloaded zip", parse, tmp_path / "heads.zip")


LABEL = "seq1/frame00001.png 1 2 3 1 0 0 0"


@pytest.mark.parametrize(
    ("name", "read", "content"),
    [
        ("TrainSplit.txt", seven_scenes.read_split, "\n".join(f"sequence{n}" for n in range(1, 10**6))),
        ("TrainSplit.txt", seven_scenes.read_split, "sequence1" * 10**6),
        ("TrainSplit.txt", seven_scenes.read_split, "\n" * 10**6),
        ("dataset_train.txt", cambridge.read_split, "\n".join(["", "", "", *[LABEL] * 10**6])),
        ("dataset_train.txt", cambridge.read_split, "\n\n\n" + "x" * 10**7),
        ("poses.csv", lambda folder, *_: read_pose_table(folder / "poses.csv", "a", "7scenes"), POSES + "\n" * 10**6),
        ("poses.csv", lambda folder, *_: read_pose_table(folder / "poses.csv", "a", "7scenes"), POSES + "a" * 10**6),
        ("overlay.yaml", lambda folder, *_: _overlaid(folder), "[" * 10**5),
        ("overlay.yaml", lambda folder, *_: _overlaid(folder), LAUGHS),
        ("recipe.yaml", lambda folder, *_: recipe_arguments([str(folder / "recipe.yaml")]), LAUGHS),
        ("recipe.yaml", lambda folder, *_: recipe_arguments([str(folder / "recipe.yaml")]), "model: &a [*a]"),
        ("sweep.yaml", lambda folder, *_: read_sweep(folder / "sweep.yaml"), "a: {" * 10**5),
    ],
    ids=lambda value: value if isinstance(value, str) and len(value) < 20 else None,
)
def test_files_without_end(name, read, content, tmp_path, tally):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError) as told:
        read(tmp_path, "train", BadFrames())
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 1000
    tally(f"{name}: a million lines, or one without end", "one line")


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_pictures(suffix, scenes, tmp_path, fed):
    import cv2

    path = tmp_path / f"picture.{suffix}"
    cv2.imwrite(str(path), cv2.imread(str(scenes / "heads/seq-01/frame-000000.color.png")))

    def parse(file: Path) -> None:
        if isinstance(found := decode_image(file.read_bytes()), str):
            raise InputError(found)

    fed(f"{suffix.upper()} image", parse, path)


def test_overlays(tmp_path, fed):
    overlay = shutil.copy(REPOSITORY / "recipes/overlays/redkitchen_blocks.yaml", tmp_path)
    fed("overlay", lambda path: BenchmarkConfig("mambaloc").with_overlay(path), Path(overlay))


def test_sweeps(tmp_path, fed):
    sweep = shutil.copy(REPOSITORY / "recipes/sweeps/redkitchen_blocks.yaml", tmp_path)
    fed("sweep", read_sweep, Path(sweep))


def test_manifests(tmp_path, fed):
    folder = shutil.copytree(RELEASED, tmp_path / "released")
    fed("manifest", lambda path: Manifest.read(path.parent), folder / "manifest.yaml")


def test_released_weights(tmp_path, fed):
    folder = shutil.copytree(RELEASED, tmp_path / "student.embedded_room")
    fed("safetensors", lambda path: load_released(path.parent), folder / "weights.safetensors")


def test_contracts(tmp_path, fed):
    said = {
        "contract": 1,
        "model": "student",
        "scene": "7scenes/heads",
        "preprocessing": {"short_side": 36, "crop": [32, 40], "in_model": False},
        "trained": {"commit": "abc"},
        "weights_sha256": "0" * 64,
        "pose": "world_from_cam",
        "undistortion": {
            "lens": {
                "opencv": "fisheye",
                "width": 64,
                "height": 48,
                "focal_px": [50, 50],
                "centre_px": [31, 24],
                "coefficients": [0.02, 0, 0, 0],
            },
            "leaves": {"width": 64, "height": 48, "focal_px": [55, 55], "centre_px": [31, 24]},
        },
    }
    path = tmp_path / "contract.json"
    path.write_text(json.dumps(said, indent=1))
    fed("contract", lambda file: Contract.from_json(file.read_bytes().decode(errors="replace"), str(file)), path)


@pytest.mark.slow
def test_checkpoints(trained, tmp_path, fed):
    fed("checkpoint", read_checkpoint, Path(shutil.copy(trained / "checkpoints/last.ckpt", tmp_path)))


@pytest.mark.slow
def test_bundles(inputs, tmp_path, fed):
    folder = shutil.copytree(inputs / "bundle", tmp_path / "bundle")
    fed("bundle's contract", lambda path: verify_bundle(path.parent, 1), folder / "contract.json")


@pytest.mark.slow
def test_models(inputs, tmp_path):
    model = Path(shutil.copy(inputs / "model.onnx", tmp_path))
    refusals = (RuntimeError("Load model failed:\nProtobuf parsing failed."), MemoryError(), ValueError("\n"))
    for refusal in refusals:  # as ONNX Runtime refuses a file; none that is damaged is handed to its parser here
        with mock.patch("onnxruntime.InferenceSession", side_effect=refusal), pytest.raises(InputError) as caught:
            Localizer(model, 1)
        assert "\n" not in str(caught.value)
        assert "ONNX Runtime cannot load it" in str(caught.value)
