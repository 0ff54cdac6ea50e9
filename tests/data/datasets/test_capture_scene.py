"""Imported scenes as a dataset: strict reading, splits as they are marked, and a path in place of a name."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.data import PoseDataModule
from mambaloc.data.datasets.capture import COLUMNS, is_captured, read_rows, read_split
from mambaloc.data.datasets.registry import licence_of_weights, locate, scene_folder
from mambaloc.data.frames import BadFrames
from mambaloc.errors import InputError
from mambaloc.export import contract_of
from mambaloc.models.student import LitStudent

SPLITS = ("train",) * 6 + ("unused",) * 2 + ("val",) * 2 + ("test",) * 3


@pytest.fixture
def scene(tmp_path):
    """Thirteen frames, written by hand; an image's red says which one it is."""
    folder = tmp_path / "scenes" / "den"
    (folder / "images" / "walk").mkdir(parents=True)
    rng = np.random.default_rng(3)
    lines = [",".join(COLUMNS)]
    for row, split in enumerate(SPLITS):
        image = f"images/walk/{row:03d}.png"
        cv2.imwrite(str(folder / image), np.full((24, 32, 3), (0, 0, 10 * row), np.uint8))
        quaternion = Rotation.from_quat(rng.normal(size=4)).as_quat(canonical=True)[[3, 0, 1, 2]]
        pose = ",".join(repr(float(n)) for n in (*rng.uniform(-3, 3, 3), *quaternion))
        lines.append(f"{image},walk,{row / 10},{pose},phone,{split}")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    told = {
        "mambaloc_scene": 1,
        "imported": {"format": "nerfstudio"},
        "unit": "metre",
        "cameras": {"phone": {"width": 32, "height": 24, "focal_px": [28.0, 28.0], "centre_px": [15.5, 11.5]}},
        "sanity": {"verdict": "usable"},
        "split": {"chosen": "block"},
    }
    (folder / "scene.json").write_text(json.dumps(told))
    return folder


def edit(scene, **values):
    told = json.loads((scene / "scene.json").read_text())
    (scene / "scene.json").write_text(json.dumps({**told, **values}))


def edit_row(scene, number, column, value):
    """Change a value of a row, counted from 0; its line in the file is two more."""
    lines = (scene / "frames.csv").read_text().splitlines()
    words = lines[number + 1].split(",")
    words[COLUMNS.index(column)] = value
    lines[number + 1] = ",".join(words)
    (scene / "frames.csv").write_text("\n".join(lines) + "\n")


# --- reading ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_a_split_is_what_is_marked_so(scene, split):
    frames = read_split(scene, split, BadFrames())
    rows = [row for row, part in enumerate(SPLITS) if part == split]
    assert [path.name for path in frames.image_paths] == [f"{row:03d}.png" for row in rows]
    assert set(frames.sequences) == {"walk"}
    table = [line.split(",") for line in (scene / "frames.csv").read_text().splitlines()[1:]]
    poses = np.array([[float(word) for word in table[row][3:10]] for row in rows])
    np.testing.assert_array_equal(frames.position_m, poses[:, :3])
    np.testing.assert_allclose(frames.quaternion, poses[:, 3:], atol=1e-12)


def test_quaternions_become_canonical(scene):
    row = read_rows(scene)[0]
    for name, value in zip(("qw", "qx", "qy", "qz"), row.pose[3:], strict=True):
        edit_row(scene, 0, name, repr(-value))
    np.testing.assert_allclose(read_split(scene, "train", BadFrames()).quaternion[0], row.pose[3:], atol=1e-12)


def test_a_missing_image_is_rejected_or_skipped_and_counted(scene):
    (scene / "images/walk/002.png").unlink()
    with pytest.raises(InputError, match=r"002\.png: pose without image"):
        read_split(scene, "train", BadFrames())
    bad = BadFrames("skip")
    assert len(read_split(scene, "train", bad)) == 5
    assert bad.counts() == {"pose without image": 1}


BAD_ROWS = {
    "line 4: image '../../x.png' is not a path inside": ("image", "../../x.png"),
    "line 4: image '/x.png' is not a path inside": ("image", "/x.png"),
    "line 4: image '' is not a path inside": ("image", ""),
    "line 4: images/walk/001.png is on line 3, too": ("image", "images/walk/001.png"),
    "line 4: names no sequence": ("sequence", ""),
    "are not all numbers": ("x", "one"),
    "are not all numbers ": ("time_s", "soon"),
    "line 4: has NaN or infinite numbers": ("y", "nan"),
    "line 4: has NaN or infinite numbers ": ("qw", "inf"),
    "line 4: has NaN or infinite numbers  ": ("time_s", "-inf"),
    "line 4: lies farther than 1e+07 from the origin": ("z", "1e9"),
    "line 4: quaternion has length": ("qw", "3"),
    "line 4: split 'validation' is not one of train, val, test, unused": ("split", "validation"),
    "line 4: has 13 columns, not 12": ("split", "train,x"),
}


@pytest.mark.parametrize(("message", "change"), BAD_ROWS.items())
def test_a_bad_row_is_named_by_its_line(scene, message, change):
    edit_row(scene, 2, *change)
    for policy in ("error", "skip"):  # a table that is wrong is not a bad frame
        with pytest.raises(InputError, match=re.escape(message.strip())) as caught:
            read_split(scene, "train", BadFrames(policy))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "frames.csv: cannot be read"),
        (b"", "frames.csv, line 1: is not image,sequence"),
        (b"image,split\n", "frames.csv, line 1: is not image,sequence"),
        (",".join(COLUMNS).encode() + b"\n", "frames.csv: has no row"),
        (bytes(range(256)), "frames.csv: is not CSV"),
        (",".join(COLUMNS).encode() + b'\n"a\n', "frames.csv: is not CSV"),
    ],
)
def test_a_table_that_is_none(scene, content, message):
    (scene / "frames.csv").unlink()
    if content is not None:
        (scene / "frames.csv").write_bytes(content)
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_split(scene, "train", BadFrames())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "scene.json: is not JSON"),
        ("[]", "scene.json: is not of an imported scene"),
        ('{"mambaloc_scene": 2}', "scene.json: has version 2, but 1 is expected"),
        ('{"mambaloc_scene": 1, "sanity": {"verdict": "not usable: 3 frames"}}', "was found not usable: 3 frames"),
    ],
)
def test_a_scene_that_is_none(scene, content, message):
    (scene / "scene.json").write_text(content)
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_split(scene, "train", BadFrames())
    assert "\n" not in str(caught.value)


def test_a_split_without_frames(scene):
    for row in (10, 11, 12):
        edit_row(scene, row, "split", "unused")
    with pytest.raises(InputError, match=r"has no usable frame of split test"):
        read_split(scene, "test", BadFrames())


# --- as a dataset ----------------------------------------------------------------------------------------------------


def module(scene, tmp_path, **values):
    values = {"image_size": 16, "short_side": 24, "cache_dir": str(tmp_path / "cache"), **values}
    return PoseDataModule(scene=scene if isinstance(scene, str) else str(scene), **values)


@pytest.mark.parametrize("dataset", ["7scenes", "cambridge", "embedded", "capture"])
def test_a_path_is_read_whatever_the_recipes_dataset_is(scene, tmp_path, dataset):
    data = module(scene, tmp_path, dataset=dataset, root=str(tmp_path / "elsewhere"))
    data.setup("fit")
    data.setup("test")
    assert {part: len(data.frames(part)) for part in ("train", "val", "test")} == {"train": 6, "val": 2, "test": 3}
    said = data.describe()
    assert (said["dataset"], said["scene"], said["official_split"]) == ("capture", "den", False)
    assert (said["unit"], said["format"], said["split_by"]) == ("metre", "nerfstudio", "block")
    assert said["listed_frames"] == {"train": 6, "val": 2, "test": 3}
    contract = contract_of(LitStudent(backbone="resnet10t", width=8, image_size=16), data.hparams)
    assert contract.scene == "capture/den"
    assert "who took them" in licence_of_weights(data.hparams["dataset"])
    again = PoseDataModule(**{name: value for name, value in data.hparams.items() if not name.startswith("_")})
    assert again.folder == data.folder == scene


def test_where_a_path_leads(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expected = ("capture", "scenes", "den")
    for name in ("scenes/den", "./scenes/den", "scenes/den/"):
        assert locate("7scenes", None, name) == expected
    assert locate("7scenes", "scenes", "den") == expected
    assert locate("7scenes", None, "heads") == ("7scenes", None, "heads")
    assert locate("embedded", None, "heads") == ("embedded", None, "room")  # heads is the default of all datasets
    monkeypatch.chdir(tmp_path / "scenes")
    assert locate("7scenes", None, "den") == ("7scenes", None, "den")  # a plain name is one of the dataset's scenes
    assert locate("7scenes", None, "./den") == ("capture", ".", "den")
    monkeypatch.chdir(scene)
    assert locate("7scenes", None, "./") == ("capture", str(tmp_path / "scenes"), "den")


def test_what_is_no_scene_says_how_to_make_one(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "raw").mkdir()
    for name, message in {
        "scenes/dan": "scenes/dan: is not an imported scene; make one with: mambaloc import CAPTURE --out",
        "./raw": "raw: is not an imported scene; make one with: mambaloc import raw --out scenes/raw",
    }.items():
        with pytest.raises(InputError, match=re.escape(message)):
            scene_folder(*[None if part is None else part for part in locate("7scenes", None, name)])
    with pytest.raises(InputError, match="scenes/dan: is not an imported scene; make one with"):
        scene_folder("capture", None, "dan")
    monkeypatch.chdir(tmp_path / "scenes")
    with pytest.raises(InputError, match=re.escape("If you mean the imported scene here, name its path, ./den.")):
        scene_folder("7scenes", None, "den")
    assert is_captured(scene)
    assert not is_captured(tmp_path)


def test_validation_takes_what_is_marked_or_holds_out_as_ever(scene, tmp_path):
    def parts(**values):
        data = module(scene, tmp_path, **values)
        data.setup("fit")
        return len(data.frames("train")), len(data.frames("val"))

    assert parts() == parts(validation="marked") == (6, 2)
    assert parts(validation="block", val_gap=1, val_fraction=0.3) == (3, 2)
    for row in (8, 9):
        edit_row(scene, row, "split", "unused")
    assert parts(val_gap=0) == (5, 1)
    with pytest.raises(InputError, match=r"data\.validation marked: .*den marks no frames as val"):
        parts(validation="marked")


def test_marked_needs_a_scene_that_marks(write_tiny_scene, tmp_path):
    tiny = write_tiny_scene({1: 4}, test=())
    data = PoseDataModule(root=str(tiny.folder.parent), scene="den", image_size=16, short_side=24, validation="marked")
    with pytest.raises(InputError, match="marks no frames as val"):
        data.setup("fit")


def test_a_bad_validation_image_is_skipped_and_counted(scene, tmp_path):
    (scene / "images/walk/008.png").write_bytes(b"no image")
    data = module(scene, tmp_path, on_bad_frame="skip")
    data.setup("fit")
    assert len(data.frames("val")) == 1
    assert data.describe()["skipped"]["val"] == {"image cannot be decoded": 1}


def test_a_camera_of_pictures_of_another_shape_is_refused(scene, tmp_path):
    phone = {"width": 640, "height": 480, "focal_px": [560.0, 560.0], "centre_px": [319.5, 239.5]}  # as 32x24
    edit(scene, cameras={"phone": phone})
    module(scene, tmp_path).setup("fit")
    edit(scene, cameras={"phone": {**phone, "height": 360}})
    with pytest.raises(InputError, match=r"\.png: has another shape than its camera's 640x360 pixels\. Give the"):
        module(scene, tmp_path).setup("fit")


@pytest.mark.parametrize("has_cameras", [True, False])
def test_upright_and_lying_pictures_train_together(scene, tmp_path, has_cameras):
    """A bright spot on a known ray is where the intrinsics of the middle say, whatever its image's shape."""
    shapes = {"phone": (32, 24), "tablet": (48, 64)}
    ray, cameras, expected = np.array([0.1, 0.2, 1.0]), {}, {}
    for name, (width, height) in shapes.items():
        matrix = np.array([[30.0, 0, width / 2 - 0.5], [0, 30.0, height / 2 - 0.5], [0, 0, 1]])
        cameras[name] = {"width": width, "height": height, "focal_px": [30.0] * 2, "centre_px": matrix[:2, 2].tolist()}
        column, row, _ = matrix @ ray
        image = np.zeros((height, width, 3), np.uint8)
        cv2.circle(image, (round(16 * column), round(16 * row)), 2 * 16, (255, 255, 255), -1, cv2.LINE_AA, shift=4)
        expected[name] = image
    for number in range(len(SPLITS)):
        name = "tablet" if number % 2 else "phone"
        cv2.imwrite(str(scene / f"images/walk/{number:03d}.png"), expected[name])
        edit_row(scene, number, "camera", name if has_cameras else "")
    edit(scene, cameras=cameras if has_cameras else {})
    data = module(scene, tmp_path)
    data.setup("fit")
    batch = data.scene.items("train").__getitems__(list(range(6)))
    assert batch.image.shape == (6, 3, 24, 24)
    for image, intrinsics in zip(batch.image[:, 0].double(), batch.intrinsics.double(), strict=True):
        rows, columns = np.mgrid[:24, :24]
        spot = [float((image * each).sum() / image.sum()) for each in (columns, rows)]
        if has_cameras:
            np.testing.assert_allclose(intrinsics[:2] @ ray, spot, atol=0.1)
        else:
            assert intrinsics[0, 2] == intrinsics[1, 2] == 11.5
