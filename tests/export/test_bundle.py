"""Bundles: every model in them finds what PyTorch finds, and what was changed is found out."""

import copy
import json
import re
import shutil
from dataclasses import replace
from importlib import resources

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.export import TARGETS, write_bundle
from mambaloc.export import bundle as bundle_module
from mambaloc.export.maps import check_scene
from mambaloc.export.precision import half_precision
from mambaloc.export.preprocessing import with_preprocessing
from mambaloc.models.student import LitStudent
from mambaloc.runtime import Localizer, Preprocessing, localization
from mambaloc.runtime.bundle import verify_bundle
from mambaloc.runtime.maps import SparseMap, absolute_pose, acceptance, drift, features, lens, sparse_map, viewpoints
from mambaloc.runtime.maps import localizer as maps_localizer
from mambaloc.runtime.maps.localizer import near_px

pytestmark = pytest.mark.usefixtures("converted_once")


@pytest.fixture(scope="module")
def student():
    torch.manual_seed(0)
    system = LitStudent(backbone="resnet10t", width=16, image_size=(32, 40))
    system.network.head.position_scale.fit(torch.randn(9, 3) + torch.tensor([300.0, 0.0, -40.0]))
    system.provenance = {"commit": "abc", "versions": {"torch": "2"}}
    return system


@pytest.fixture(scope="module")
def data(den):
    return PoseDataModule("7scenes", str(den), "den", image_size=(32, 40), short_side=36)


@pytest.fixture(scope="module", params=[False, True], ids=["tensors", "pictures"])
def bundle(request, student, data, map_of_den, tmp_path_factory):
    """With a map where the models take images, without one where they take tensors."""
    folder, raw = tmp_path_factory.mktemp("bundles") / "new" / "bundle", request.param
    formats, sparse_map = ("onnx", "fp16", "ort"), map_of_den if raw else None
    deviations = write_bundle(student, data, folder, formats, raw_input=raw, sparse_map=sparse_map).deviations
    return folder, deviations


@pytest.mark.slow
def test_every_model_finds_what_pytorch_finds(bundle):
    folder, deviations = bundle
    names = ["model.onnx", "model.fp16.onnx", "model.ort"]
    in_map = ["map.safetensors"] if (folder / "map.safetensors").exists() else []
    assert [each.file for each in deviations] == names + in_map
    assert [each.file for each in verify_bundle(folder)] == names + in_map
    exact, half, ort = (each.position_mm for each in deviations[:3])
    assert exact < 1
    assert ort < 1
    assert half < 20  # 300 m from the origin, where float16 knows quarters of a metre
    assert all(each.within for each in deviations)
    assert not list(folder.parent.glob(".*"))


@pytest.mark.slow
def test_a_network_that_one_grey_level_moves_gets_its_bundle(student, data, tmp_path):
    """Of a network trained for a minute, a few levels that any resize may round change the pose by millimetres."""
    unsteady = copy.deepcopy(student)
    with torch.no_grad():
        unsteady.network.backbone.model.conv1[0].weight *= 1000
    (deviation,) = write_bundle(unsteady, data, tmp_path / "bundle", ("onnx",)).deviations
    contract = json.loads((tmp_path / "bundle" / "contract.json").read_text())
    moved_mm = max(frame["by_rounding"]["position_mm"] for frame in contract["frames"])
    assert moved_mm > 1
    size_m = float(unsteady.network.head.position_scale.scale_m.max())
    allowed = contract["files"]["model.onnx"]["allowed"]
    assert allowed["position_mm"] == pytest.approx(max(1, size_m) + 2 * moved_mm)
    assert max(1, size_m) < deviation.position_mm < allowed["position_mm"]


@pytest.mark.slow
def test_a_bundle_tells_an_app_what_it_needs(bundle):
    folder, _ = bundle
    contract = json.loads((folder / "contract.json").read_text())
    raw = contract["preprocessing"]["in_model"]
    assert contract["input"]["name"] == ("rgb" if raw else "image")
    session = onnxruntime.InferenceSession(str(folder / "model.onnx"), providers=["CPUExecutionProvider"])
    (tensor,) = session.get_inputs()
    assert (tensor.name, tensor.type) == (contract["input"]["name"], "tensor(uint8)" if raw else "tensor(float)")
    assert [o.name for o in session.get_outputs()] == list(contract["outputs"])
    assert len(contract["frames"]) == 5
    assert Localizer(folder).contract.scene == "7scenes/den"
    assert "Conv" in (folder / "required_operators_and_types.config").read_text()
    assert (folder / "model.fp16.onnx").stat().st_size < 0.6 * (folder / "model.onnx").stat().st_size
    assert "versions: torch 2" in (folder / "README.md").read_text()
    assert "non-commercial" in (folder / "LICENSE.txt").read_text()
    assert "onnxruntime-android" in (folder / "INTEGRATION.md").read_text()
    listed = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert listed == {"contract.json", *contract["files"]}  # a digest of every file


@pytest.mark.slow
def test_a_bundle_tells_where_training_frames_were_taken(bundle, data):
    sequences = json.loads((bundle[0] / "trajectory.json").read_text())["sequences"]
    frames = data.listed_training_frames()
    assert list(sequences) == ["seq-01"]
    found = np.concatenate(list(sequences.values()))
    np.testing.assert_allclose(found, np.hstack([frames.position_m, frames.quaternion]), atol=1e-5)


# --- maps -------------------------------------------------------------------------------------------------------------


with_map = pytest.mark.parametrize("bundle", [True], indirect=True, ids=["pictures"])


@pytest.fixture
def mapped(bundle, tmp_path):
    return shutil.copytree(bundle[0], tmp_path / "mapped")


@pytest.mark.slow
@with_map
def test_a_map_is_described_with_poses_that_a_port_must_find(mapped, map_of_den, data):
    contract, sparse_map = json.loads((mapped / "contract.json").read_text()), SparseMap.load(map_of_den)
    assert (mapped / "map.safetensors").read_bytes() == map_of_den.read_bytes()
    described = contract["map"]
    assert (described["points"], described["key_frames"]) == (len(sparse_map), len(sparse_map.key_poses))
    assert (described["scene"], described["size"], described["keypoints"]) == ("den", [160, 120], "sift")
    assert described["accepted"]["least_probability"] == acceptance.MIN_PROBABILITY
    assert described["accepted"]["most_deviation"] == acceptance.MAX_DEVIATION
    assert described["accepted"]["calibrated_on"]["frames"] > 100
    assert described["allowed"] == {"position_mm": 10, "rotation_deg": 0.3}
    frames = data.frames("test")
    chosen = frames.select(np.array(frames.evenly_spread(5)))
    for frame, true_m in zip(contract["frames"], chosen.position_m, strict=True):
        assert frame["intrinsics"] == [[144, 0, 79.5], [0, 144, 59.5], [0, 0, 1]]  # of 160x120, as it was rendered
        assert frame["map"]["inliers"] >= sparse_map.least_inliers
        np.testing.assert_allclose(frame["map"]["position_m"], true_m, atol=0.03)
    assert "`map.safetensors`: sparse map" in (mapped / "README.md").read_text()
    assert "namespace mambaloc" in (mapped / "map_localiser.hpp").read_text()


@pytest.mark.slow
@with_map
@pytest.mark.parametrize(("off_m", "is_within"), [(0.009, True), (0.011, False)])
def test_a_map_that_finds_other_poses_deviates(off_m, is_within, mapped):
    path = mapped / "contract.json"
    contract = json.loads(path.read_text())
    contract["frames"][3]["map"]["position_m"][0] += off_m
    contract["frames"][1]["map"] = None  # of a frame that was not localized nothing is asked
    path.write_text(json.dumps(contract))
    deviation = verify_bundle(mapped)[-1]
    assert (deviation.file, deviation.within) == ("map.safetensors", is_within)
    assert deviation.position_mm == pytest.approx(1000 * off_m, abs=0.1)


@pytest.mark.slow
@with_map
def test_a_bad_description_of_a_map_is_refused(mapped):
    path = mapped / "contract.json"
    whole = json.loads(path.read_text())

    def refused(changed, message):
        path.write_text(json.dumps(changed))
        with pytest.raises(InputError, match=message) as error:
            verify_bundle(mapped)
        assert "\n" not in str(error.value)

    files = {name: entry for name, entry in whole["files"].items() if name != "map.safetensors"}
    refused({**whole, "files": files}, "describes a map without the digest")
    refused({**whole, "map": 3}, "is not a bundle's contract")
    refused({**whole, "map": {"allowed": {}}}, "is not a bundle's contract")
    frames = [{**frame, "map": 3} for frame in whole["frames"]]
    refused({**whole, "frames": frames}, "is not a bundle's contract")
    frames = [{**frame, "intrinsics": [1]} for frame in whole["frames"]]
    refused({**whole, "frames": frames}, "cannot be the camera")
    (mapped / "map.safetensors").write_bytes(b"noise")
    refused(whole, "has another sha256")


def test_a_map_of_another_scene_is_refused(student, map_of_den, scenes, tmp_path):
    other = PoseDataModule("7scenes", str(scenes), "heads", image_size=(32, 40), short_side=36)
    with pytest.raises(InputError, match=r"is a map of 'den', which localizes 0 of 8 .* of heads\. .*--no-map"):
        write_bundle(student, other, tmp_path / "bundle", sparse_map=map_of_den)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("turn_rad", [0.0, 0.6])
def test_a_map_in_another_frame_is_refused(turn_rad, map_of_den, data):
    """Its matches are as good; only where they say that the camera is differs."""
    sparse_map, moved = SparseMap.load(map_of_den), np.eye(4)
    moved[:3, :3], moved[0, 3] = cv2.Rodrigues(np.array([0, 0, turn_rad]))[0], 0.0 if turn_rad else 0.4
    points_m = (sparse_map.points_m @ moved[:3, :3].T + moved[:3, 3]).astype(np.float32)
    check_scene(map_of_den, sparse_map, data)
    with pytest.raises(InputError, match="localizes 0 of 8"):
        check_scene(map_of_den, replace(sparse_map, points_m=points_m, key_poses=moved @ sparse_map.key_poses), data)


def test_a_damaged_map_is_refused(student, data, map_of_den, tmp_path):
    (tmp_path / "map.safetensors").write_bytes(map_of_den.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"map\.safetensors: is damaged"):
        write_bundle(student, data, tmp_path / "bundle", sparse_map=tmp_path / "map.safetensors")


@pytest.mark.parametrize("target", TARGETS)
def test_every_kind_of_app_has_a_page(target):
    page = (resources.files("mambaloc.export") / "integration" / f"{target}.md").read_text()
    assert "contract.json" in page
    assert "frames" in page
    assert "map.safetensors" in page


def test_native_apps_decide_as_python_does():
    """The C++ of the bundles was run beside Python once; this holds its numbers to Python's from then on."""
    header = (resources.files("mambaloc.export") / "integration" / "map_localiser.hpp").read_text()
    written = {float(number) for number in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?:e-?\d+)?", header)}
    numbers = {
        *(
            maps_localizer._AT_ONCE,
            maps_localizer._RATIO,
            maps_localizer._GUIDED_RATIO,
            maps_localizer._GUIDED_FARTHEST,
        ),
        *(
            maps_localizer._NEAREST,
            *maps_localizer._WINDOWS,
            maps_localizer._MIN_SHARE,
            maps_localizer._PRIOR_WINDOW,
            maps_localizer._SHARED,
        ),
        *(acceptance._CELLS, acceptance.MIN_PROBABILITY, acceptance.MAX_DEVIATION, localization._UNSTATED),
        *map(abs, (acceptance._CONSTANT, acceptance._PER_CELLS, acceptance._PER_DEVIATION, acceptance._PER_TURN)),
        *(acceptance._MIN_DEVIATION, acceptance._MIN_TURN_DEG),
        *(acceptance._FOCAL_OFF, acceptance._FOCAL_DEVIATIONS),
        *(near_px(160), drift._LENGTH, drift.NUGGET, viewpoints._TURN_DEG, lens._STEPS),
        *(absolute_pose._TRIALS, absolute_pose._CONFIDENCE, absolute_pose._STEPS),
        *(features._MAX_KEYPOINTS, features._CONTRAST, sparse_map.VERSION),
    }
    assert numbers - written == set()


# --- preprocessing inside ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(480, 640), (640, 480), (97, 151), (40, 51), (36, 48)])
def test_preprocessing_inside_is_that_outside(size):
    preprocessing = Preprocessing(short_side=36, crop=(32, 34))
    network = onnx.parser.parse_model(
        '<ir_version: 10, opset_import: ["": 18]>'
        "g (float[batch, 3, 32, 34] image) => (float[batch, 3, 32, 34] said) { said = Identity(image) }"
    )
    model = with_preprocessing(network, preprocessing)
    onnx.checker.check_model(model)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    coarse = np.random.default_rng(0).integers(0, 256, (9, 12, 3), dtype=np.uint8)
    rgb = cv2.resize(coarse, size[::-1], interpolation=cv2.INTER_CUBIC)
    (inside,) = session.run(None, {"rgb": rgb})
    outside = preprocessing.apply(rgb).transpose(2, 0, 1)
    difference = np.abs(inside[0] * 255 - outside)
    assert difference.max() <= 1.01  # a grey level, where rounding falls the other way
    assert difference.mean() < 0.05


# --- half precision ---------------------------------------------------------------------------------------------------


def test_half_precision_leaves_the_scene_in_metres_alone():
    """(x W) scaled to metres: the product before the last is halved, the last and the offset are not."""
    model = onnx.parser.parse_model(
        '<ir_version: 10, opset_import: ["": 18]>'
        "g (float[1, 2] x) => (float[1, 2] position_m)"
        "<float[2, 2] w = {1, 0, 0, 1}, float[2] metres = {312.3, -0.07}> {"
        "a = MatMul(x, w) b = Relu(a) c = MatMul(b, w) position_m = Add(c, metres) }"
    )
    for number, node in enumerate(model.graph.node):
        node.name = f"node_{number}"
    half = half_precision(model)
    onnx.checker.check_model(half)
    types = {i.name: i.data_type for i in half.graph.initializer}
    assert onnx.TensorProto.FLOAT16 in types.values()
    session = onnxruntime.InferenceSession(half.SerializeToString(), providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"x": np.array([[0.5, 0.25]], np.float32)})
    np.testing.assert_allclose(found, [[312.8, 0.18]], atol=1e-4)  # float16 alone would say 312.75


# --- what goes wrong --------------------------------------------------------------------------------------------------


@pytest.fixture
def copied(bundle, tmp_path):
    shutil.copytree(bundle[0], tmp_path / "bundle")
    return tmp_path / "bundle"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["model.onnx", "model.ort", "frames/2.png"])
def test_a_changed_byte_is_found_out(copied, name):
    content = bytearray((copied / name).read_bytes())
    content[len(content) // 2] ^= 1
    (copied / name).write_bytes(content)
    with pytest.raises(InputError, match="has another sha256") as error:
        verify_bundle(copied)
    assert name in str(error.value)


@pytest.mark.slow
def test_a_contract_that_is_none_is_refused(copied):
    path = copied / "contract.json"
    whole = json.loads(path.read_text())

    def refused(content, message):
        path.write_text(content)
        with pytest.raises(InputError, match=message):
            verify_bundle(copied)

    refused("{", "is not a bundle's contract")
    refused("[]", "is not a bundle's contract")
    for name in (
        "../model.onnx",
        f"../{copied.name}/model.onnx",
        str(copied / "model.onnx"),
        "frames\\0.png",
        "C:x",
        "",
    ):
        refused(json.dumps({**whole, "files": {name: {"sha256": ""}}}), "outside of the bundle")
    refused(json.dumps({**whole, "frames": [{"file": "/etc/hostname"}]}), "without its digest")
    refused(json.dumps({**whole, "files": {}, "frames": []}), "contains no model")
    refused("[" * 100_000, "is not a bundle's contract")
    refused(json.dumps({**whole, "files": {"gone.onnx": {"sha256": ""}}}), "gone.onnx: cannot be read")
    refused(json.dumps({**whole, "frames": [{"file": "frames/0.png"}]}), "is not a bundle's contract")
    path.unlink()
    with pytest.raises(InputError, match="give a bundle's folder"):
        verify_bundle(copied)


@pytest.mark.slow
def test_a_model_that_deviates_is_not_shipped(student, data, tmp_path, monkeypatch):
    monkeypatch.setattr(bundle_module, "_ALLOWED", {"fp16": (0.0, 0.0)})
    monkeypatch.setattr(bundle_module, "_TIES_ALLOWED", 0.0)
    with pytest.raises(InputError, match=r"model\.fp16\.onnx: deviates by"):
        write_bundle(student, data, tmp_path / "bundle", ("fp16",))
    assert not list(tmp_path.iterdir())


def test_a_bundle_is_never_written_over(student, data, tmp_path):
    with pytest.raises(InputError, match="already exists"):
        write_bundle(student, data, tmp_path)
