"""Every registered system in ONNX Runtime: each distinct graph is exported, and systems that share one are compared."""

import pytest
import torch
from systems import SIDE, frames, small
from torch.fx.experimental.proxy_tensor import make_fx

import mambaloc
from mambaloc.export import contract_of, export_onnx
from mambaloc.models import lstm_posenet
from mambaloc.uncertainty import ErrorsByDistance, UncertaintyHead, seen_of

SAME_GRAPH = {"posenet_learned": "posenet", "posenet_geometric": "posenet", "mambaloc": "transposenet"}
"""Systems that differ from another in their losses or defaults alone; a system that is not listed is exported."""


def assert_onnx_runtime_agrees(name, path):
    system = small(name, "gis")
    with torch.no_grad():
        uncertainty = UncertaintyHead(seen_of(system.network.eval(), [frames(4).image]))
    uncertainty.calibrate(ErrorsByDistance(*torch.rand(3, 20) + 0.1), 0.9)
    contract = contract_of(system, {"dataset": "7scenes", "scene": "heads", "short_side": SIDE}, uncertainty)
    parity = export_onnx(system, path, contract, uncertainty, tolerance_m=1e-4, tolerance_deg=0.01)
    assert path.is_file()
    assert parity.position_m < 1e-4
    assert parity.uncertainty < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in mambaloc.list_models() if name not in SAME_GRAPH])
def test_onnx_runtime_agrees(name, tmp_path, monkeypatch):
    monkeypatch.setattr(lstm_posenet, "_ROWS", 4)  # the exporter unrolls LSTMs: 12 steps instead of 96
    monkeypatch.setattr(lstm_posenet, "_COLUMNS", 8)
    assert_onnx_runtime_agrees(name, tmp_path / "model.onnx")


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["lstm_posenet", *SAME_GRAPH])
def test_onnx_runtime_agrees_at_full_length_and_for_each_name(name, tmp_path):
    """Takes 5 to 20 s each: all 96 steps of the LSTMs are unrolled."""
    assert_onnx_runtime_agrees(name, tmp_path / "model.onnx")


@torch.no_grad()
def graph_of(name):
    """The ATen operations of a system's network, and the shapes of its weights: what the exporter sees."""
    network = small(name, "gis").network.eval()
    operations = make_fx(lambda image: vars(network(image)))(frames().image).code
    return operations, {key: value.shape for key, value in network.state_dict().items()}


@pytest.mark.parametrize(("name", "exported"), SAME_GRAPH.items())
def test_a_system_that_is_not_exported_shares_the_graph_of_one_that_is(name, exported):
    assert exported not in SAME_GRAPH
    assert graph_of(name) == graph_of(exported)


def test_graphs_of_different_networks_differ():
    assert graph_of("posenet") != graph_of("mapnet")
    assert graph_of("posenet") != graph_of("transposenet")
