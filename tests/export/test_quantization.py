"""Eight bits: how small, how far off, and what the gate does with it."""

import json
import shutil

import numpy as np
import onnx
import pytest
import torch

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.export import contract_of, export_onnx, quantization, write_bundle
from mambaloc.export.quantization import eight_bit, median_errors, sensitive_nodes
from mambaloc.metrics import summarize
from mambaloc.models.student import LitStudent

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("converted_once")]


@pytest.fixture(scope="module")
def data(scenes):
    return PoseDataModule("7scenes", str(scenes), "heads", image_size=(32, 40), short_side=36)


@pytest.fixture(scope="module")
def student(data):
    torch.manual_seed(0)
    system = LitStudent(backbone="resnet10t", width=16, image_size=(32, 40))
    system.network.head.position_scale.fit(torch.from_numpy(data.listed_training_frames().position_m))
    return system.eval()


@pytest.fixture(scope="module")
def network(student, data, tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "model.onnx"
    export_onnx(student, path, contract_of(student, data.hparams))
    return onnx.load(path)


@pytest.fixture(scope="module")
def int8(network, data):
    return eight_bit(network, data)


def test_medians_in_onnx_runtime_are_those_of_an_evaluation(network, student, data):
    data.setup("test")
    expected = summarize(localize_test_frames(student, data, "cpu"))
    assert median_errors(network, data) == pytest.approx(expected, rel=1e-4)


def test_eight_bits_are_a_quarter_and_find_nearly_the_same(int8, network):
    assert int8.within_tolerance
    assert int8.kind == "all layers"
    assert int8.loss < 0.1
    assert int8.frames == 8
    kinds = {initializer.data_type for initializer in int8.model.graph.initializer}
    assert onnx.TensorProto.INT8 in kinds
    assert len(int8.model.SerializeToString()) < 0.32 * len(network.SerializeToString())


def test_all_bits_of_a_weight_are_used(int8):
    weights = [
        onnx.numpy_helper.to_array(i) for i in int8.model.graph.initializer if i.data_type == onnx.TensorProto.INT8
    ]
    assert max(np.abs(weight).max() for weight in weights) == 127


def test_what_is_kept_when_all_layers_lose_too_much(network, data, monkeypatch):
    monkeypatch.setattr(quantization, "LARGEST_LOSS", -1.0)  # nothing can be so good
    found = eight_bit(network, data)
    assert found.kind == "mixed"
    assert not found.within_tolerance
    assert "left out" in str(found)
    kept = sensitive_nodes(quantization._prepared(network).graph)
    quantized = {name for node in found.model.graph.node if node.name in kept for name in node.input}
    assert not any("Dequantize" in name for name in quantized)


def test_the_first_layer_the_gates_and_the_heads_are_sensitive():
    graph = onnx.parser.parse_model(
        '<ir_version: 10, opset_import: ["": 18]>'
        "g (float[1, 3, 8, 8] image) => (float[1, 2] position_m)"
        "<float[4, 3, 3, 3] w, float[4, 4, 3, 3] v, float[4, 4, 1, 1] gate, float[4, 2] head, int64[1] two = {2}> {"
        "a = Conv<pads = [1, 1, 1, 1]>(image, w) pooled = GlobalAveragePool(a) b = Conv(pooled, gate)"
        "c = Mul(a, b) d = Conv(c, v) e = GlobalAveragePool(d) f = Flatten(e) position_m = MatMul(f, head) }"
    ).graph
    graph = onnx.shape_inference.infer_shapes(onnx.helper.make_model(graph)).graph
    for number, node in enumerate(graph.node):
        node.name = f"node_{number}"
    assert sensitive_nodes(graph) == ["node_0", "node_2", "node_7"]


def test_a_bundle_ships_what_fits_and_says_how_it_went(student, data, tmp_path):
    written = write_bundle(student, data, tmp_path / "bundle", ("onnx", "int8"))
    assert [each.file for each in written.deviations] == ["model.onnx", "model.int8.onnx"]
    assert all(each.within for each in written.deviations)
    entry = json.loads((tmp_path / "bundle/contract.json").read_text())["files"]["model.int8.onnx"]
    assert entry["quantised"]["layers"] == "all layers"
    assert "8 test frames" in entry["quantised"]["measured_on"]


def test_a_bundle_leaves_out_what_loses_too_much(student, data, tmp_path, monkeypatch):
    monkeypatch.setattr(quantization, "LARGEST_LOSS", -1.0)
    written = write_bundle(student, data, tmp_path / "bundle", ("onnx", "int8"))
    assert [each.file for each in written.deviations] == ["model.onnx"]
    assert not written.int8.within_tolerance
    assert not (tmp_path / "bundle/model.int8.onnx").exists()
    with pytest.raises(InputError, match="nothing to write: int8"):
        write_bundle(student, data, tmp_path / "other", ("int8",))
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def test_without_training_frames_nothing_is_quantized(network, scenes, tmp_path):
    shutil.copytree(scenes / "heads", tmp_path / "heads")
    (tmp_path / "heads/TrainSplit.txt").unlink()
    data = PoseDataModule("7scenes", str(tmp_path), "heads", image_size=(32, 40), short_side=36)
    with pytest.raises(InputError, match="TrainSplit"):
        eight_bit(network, data)
