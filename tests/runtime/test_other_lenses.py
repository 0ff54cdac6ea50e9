"""A model that takes intrinsics is given those of the network's input, whatever lens took the image.

What stands for a network answers with what it was given, so that no training is needed.
"""

import json
from dataclasses import replace

import cv2
import numpy as np
import onnx
import pytest

from mambaloc.errors import InputError
from mambaloc.export.preprocessing import with_preprocessing
from mambaloc.images import read_image
from mambaloc.runtime import Contract, Localizer, Preprocessing
from mambaloc.runtime.contract import MAX_ENLARGEMENT
from mambaloc.runtime.maps import SparseMap
from mambaloc.runtime.network import Network

TRAINED = ((120.0, 0.0, 64.5), (0.0, 121.0, 47.0), (0.0, 0.0, 1.0))
CONTRACT = Contract("echo", "7scenes/den", Preprocessing(108, (96, 128)), {}, "0", None, TRAINED)
ECHO = onnx.parser.parse_model("""
    <ir_version: 10, opset_import: ["": 18]>
    echo (float[batch, 3, 96, 128] image, float[batch, 3, 3] intrinsics)
        => (float[batch, 3] position_m, float[batch, 4] quaternion_wxyz)
    <int64[1] first = {0}, int64[1] second = {1}, int64[1] third = {2}, int64[3] all = {1, 2, 3}>
    {
        row_x = Slice(intrinsics, first, second, second)
        row_y = Slice(intrinsics, second, third, second)
        position_m = Squeeze(row_x, second)
        others = Squeeze(row_y, second)
        mean = ReduceMean<keepdims = 0>(image, all)
        brightness = Unsqueeze(mean, second)
        quaternion_wxyz = Concat<axis = 1>(brightness, others)
    }
""")
"""Its position is the first row of the intrinsics; its quaternion the image's mean, and the second row."""


def written(path, contract, model=ECHO):
    """Write a model with a contract."""
    model = onnx.ModelProto.FromString(model.SerializeToString())
    model.metadata_props.add(key="mambaloc", value=contract.to_json())
    onnx.save(model, path)
    return path


@pytest.fixture(scope="module")
def echo(tmp_path_factory):
    return written(tmp_path_factory.mktemp("echo") / "model.onnx", CONTRACT)


@pytest.fixture(scope="module")
def raw_echo(tmp_path_factory):
    contract = replace(CONTRACT, preprocessing=replace(CONTRACT.preprocessing, in_model=True))
    model = with_preprocessing(ECHO, contract.preprocessing, TRAINED[0][0])
    return written(tmp_path_factory.mktemp("echo") / "raw.onnx", contract, model)


def camera(fx, cx, cy, fy=None):
    return np.array([[fx, 0, cx], [0, fy or fx, cy], [0, 0, 1.0]])


LENSES = {  # (width, height) of the image, and its camera
    "the training camera": ((640, 480), camera(533, 322, 236)),
    "shorter": ((640, 480), camera(426, 322, 236)),
    "longer": ((640, 480), camera(666, 322, 236)),
    "wide image": ((1280, 720), camera(1066, 640, 360)),
    "upright phone": ((480, 640), camera(533, 238, 321)),
    "square, off centre": ((300, 300), camera(390, 180, 120)),
    "pixels that are not square": ((640, 480), camera(533, 322, 236, fy=600)),
    "small": ((160, 120), camera(170, 80, 60)),
}
lenses = pytest.mark.parametrize("lens", LENSES)


@lenses
def test_what_a_camera_sees_falls_where_the_crops_intrinsics_say(lens):
    """A dot is drawn where the stored image's camera sees a point, and found in the crop by its centre of mass."""
    (width, height), intrinsics = LENSES[lens]
    size = (height, width)
    preprocessing = CONTRACT.preprocessing_for(size, intrinsics)
    of_crop = preprocessing.crop_from_image(size) @ intrinsics
    for x, y in ((-0.2, -0.15), (0.22, 0.1), (0.0, 0.0)):  # in the plane at depth 1
        seen, _ = cv2.projectPoints(np.array([[[x, y, 1.0]]]), np.zeros(3), np.zeros(3), intrinsics, None)
        across, down = np.meshgrid(np.arange(width), np.arange(height))
        spread = 3.0 * width / 640 + 1
        dot = 255 * np.exp(-((across - seen[0, 0, 0]) ** 2 + (down - seen[0, 0, 1]) ** 2) / (2 * spread**2))
        crop = preprocessing.apply(np.repeat(dot[..., None], 3, axis=-1).round().astype(np.uint8))[..., 0]
        assert crop.shape == (96, 128)
        rows, columns = np.mgrid[:96, :128]
        found = np.array([(columns * crop).sum(), (rows * crop).sum()]) / crop.sum()
        expected, _ = cv2.projectPoints(np.array([[[x, y, 1.0]]]), np.zeros(3), np.zeros(3), of_crop, None)
        np.testing.assert_allclose(found, expected[0, 0], atol=0.1)


@lenses
def test_things_are_as_large_as_the_training_camera_shows_them(lens):
    (width, height), intrinsics = LENSES[lens]
    size = (height, width)
    of_crop = CONTRACT.preprocessing_for(size, intrinsics).crop_from_image(size) @ intrinsics
    assert of_crop[0, 0] == pytest.approx(TRAINED[0][0], rel=0.01)


def test_the_widest_lens_is_enlarged_to_a_limit():
    preprocessing = CONTRACT.preprocessing_for((480, 640), camera(60, 320, 240))
    assert preprocessing.short_side == MAX_ENLARGEMENT * 108
    assert CONTRACT.preprocessing_for((6, 8), camera(79, 4, 3)).short_side == 9
    assert CONTRACT.preprocessing_for((2, 190), camera(1850, 95, 1, fy=19)).short_side == 1


@lenses
def test_a_model_is_given_its_inputs_camera(lens, echo):
    (width, height), intrinsics = LENSES[lens]
    size = (height, width)
    said = Localizer(echo).localize(np.full((*size, 3), 100, np.uint8), intrinsics)
    expected = CONTRACT.preprocessing_for(size, intrinsics).crop_from_image(size) @ intrinsics
    np.testing.assert_allclose(said.position_m, expected[0], rtol=1e-6)
    np.testing.assert_allclose(said.quaternion[1:], expected[1], rtol=1e-6)


@lenses
def test_a_model_that_takes_pictures_does_it_by_itself(lens, echo, raw_echo):
    (width, height), intrinsics = LENSES[lens]
    coarse = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    picture = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    expected, said = (Localizer(each).localize(picture, intrinsics) for each in (echo, raw_echo))
    np.testing.assert_allclose(said.position_m, expected.position_m, rtol=1e-5)
    np.testing.assert_allclose(said.quaternion[1:], expected.quaternion[1:], rtol=1e-5)
    assert said.quaternion[0] == pytest.approx(expected.quaternion[0], abs=1e-3)  # the image's mean


def test_an_unknown_camera_is_taken_for_the_training_camera(echo, raw_echo):
    for each in (echo, raw_echo):
        for size in ((480, 640), (120, 160), (720, 1280)):
            said = Localizer(each).localize(np.zeros((*size, 3), np.uint8))
            np.testing.assert_allclose(said.position_m, TRAINED[0], rtol=1e-5)
            np.testing.assert_allclose(said.quaternion[1:], TRAINED[1], rtol=1e-5)


def test_a_picture_that_is_too_narrow_needs_its_camera(echo, raw_echo):
    upright = np.zeros((640, 480, 3), np.uint8)
    for each in (echo, raw_echo):
        with pytest.raises(InputError, match="give frames shaped as in training, or their intrinsics"):
            Localizer(each).localize(upright)
        assert np.isfinite(Localizer(each).localize(upright, camera(533, 240, 320)).position_m).all()


@pytest.mark.parametrize(
    "intrinsics",
    [camera(53300, 320, 240), camera(533, 900, 240), np.eye(2), np.full((3, 3), np.nan)],
    ids=["telescope", "centre elsewhere", "2x2", "NaN"],
)
def test_a_camera_that_cannot_be_is_refused(intrinsics, echo):
    with pytest.raises(InputError, match="cannot be the camera of an image of 640x480") as error:
        Localizer(echo).localize(np.zeros((480, 640, 3), np.uint8), intrinsics)
    assert "\n" not in str(error.value)


def test_network_and_map_are_given_one_camera(echo, den, map_of_den, monkeypatch):
    """A frame without its lowest rows: the map finds its pose only with the true principal point."""
    path = den / "den/seq-02/frame-000002.color.png"
    intrinsics, given = SparseMap.load(map_of_den).intrinsics, []
    localize = Network.localize
    monkeypatch.setattr(Network, "localize", lambda self, rgb, k: given.extend(k) or localize(self, rgb, k))
    found = Localizer(echo, 1, map_of_den).localize(read_image(path)[:100], intrinsics)
    assert found.source == "map"
    true_m = np.loadtxt(path.with_name("frame-000002.pose.txt"))[:3, 3]
    np.testing.assert_allclose(found.position_m, true_m, atol=0.03)
    assert given[0] is intrinsics


# --- the contract -----------------------------------------------------------------------------------------------------


def test_the_contract_states_the_training_camera():
    told = json.loads(CONTRACT.to_json())
    assert told["intrinsics"] == [list(row) for row in TRAINED]
    assert told["intrinsics_input"] == {
        "name": "intrinsics", "dtype": "float32", "shape": ["batch", 3, 3], "in_pixels_of": "image"
    }  # fmt: skip
    assert Contract.from_json(CONTRACT.to_json(), "here") == CONTRACT
    plain = json.loads(replace(CONTRACT, intrinsics=None).to_json())
    assert plain["intrinsics"] is None
    assert "intrinsics_input" not in plain
    del plain["intrinsics"]  # as in contracts of before
    assert Contract.from_json(json.dumps(plain), "here").intrinsics is None


@pytest.mark.parametrize("wrong", [3, [[1, 2], [3, 4]], [[0, 0, 64], [0, 0, 48], [0, 0, 1]], "f", [["a"] * 3] * 3])
def test_a_contract_with_a_wrong_camera_is_refused(wrong):
    told = {**json.loads(CONTRACT.to_json()), "intrinsics": wrong}
    with pytest.raises(InputError, match=r"contract\.json: its contract cannot be read") as error:
        Contract.from_json(json.dumps(told), "contract.json")
    assert "\n" not in str(error.value)


def test_a_model_and_its_contract_agree_on_the_camera(tmp_path):
    without = replace(CONTRACT, intrinsics=None)
    with pytest.raises(InputError, match=r"input \['intrinsics'\] does not match its contract"):
        Localizer(written(tmp_path / "a.onnx", without))
    model = onnx.ModelProto.FromString(ECHO.SerializeToString())
    model.graph.input[1].type.tensor_type.shape.dim[2].dim_value = 4
    with pytest.raises(InputError, match="does not match its contract"):
        Localizer(written(tmp_path / "b.onnx", CONTRACT, model))
