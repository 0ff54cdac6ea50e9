"""The same network smaller, or as mobile builds of ONNX Runtime read it."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import onnx
from onnxruntime.tools.convert_onnx_models_to_ort import OptimizationStyle, convert_onnx_models_to_ort
from onnxruntime.transformers.float16 import convert_float_to_float16
from onnxruntime.transformers.onnx_model import OnnxModel


def half_precision(model: onnx.ModelProto) -> onnx.ModelProto:
    """Store and compute in float16, but the inputs, the outputs and all from the last products on.

    Positions are there in metres already, and a float16 near 300 m is a quarter of a metre off.
    """
    half = onnx.ModelProto()
    half.CopyFrom(model)  # the converter works in place
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of weights under 6e-8, which become 6e-8
        half = convert_float_to_float16(half, keep_io_types=True, node_block_list=_after_last_products(model.graph))
    _join_casts(half.graph)
    tidy = OnnxModel(half)
    tidy.prune_graph()
    tidy.topological_sort()
    return half


def _join_casts(graph: onnx.GraphProto) -> None:
    """Undo casts to float16 that are cast back at once: the converter puts a pair after every node left in float32."""
    made_by = {output: node for node in graph.node for output in node.output}
    for node in graph.node:
        before = made_by.get(node.input[0]) if node.op_type == "Cast" else None
        if before is None or before.op_type != "Cast":
            continue
        if (before.attribute[0].i, node.attribute[0].i) == (onnx.TensorProto.FLOAT16, onnx.TensorProto.FLOAT):
            node.CopyFrom(onnx.helper.make_node("Identity", before.input, node.output, node.name))


def _after_last_products(graph: onnx.GraphProto) -> list[str]:
    """Names of the nodes from the outputs back to the first product, or mean over pixels, on each way, it included."""
    made_by = {output: node for node in graph.node for output in node.output}
    waiting, found = [output.name for output in graph.output], {}
    while waiting:
        node = made_by.get(waiting.pop())
        if node is None or node.name in found:
            continue
        found[node.name] = node
        if node.op_type not in ("Gemm", "MatMul", "ReduceMean", "GlobalAveragePool"):
            waiting += node.input
    return list(found)


def write_ort(source: Path, out: Path) -> Path:
    """Write a model in ORT format, and the operators that a reduced build needs.

    It is optimised for no processor in particular: a layout of one could not be read on another.

    Args:
        source: an ONNX file.
        out: the ``.ort`` file; beside it ``required_operators_and_types.config`` is written.

    Returns:
        The file of operators.
    """
    with TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(io.StringIO()), _without_chatter():
            convert_onnx_models_to_ort(
                source,
                Path(folder),
                optimization_styles=[OptimizationStyle.Fixed],
                target_platform="arm",  # which leaves out the layout of one x86 processor
                enable_type_reduction=True,
            )
        (converted,) = Path(folder).glob("*.ort")
        (operators,) = Path(folder).glob("*.config")
        config = out.with_name("required_operators_and_types.config")
        out.write_bytes(converted.read_bytes())
        config.write_bytes(operators.read_bytes())
    return config


@contextlib.contextmanager
def _without_chatter():  # type: ignore[no-untyped-def]
    before = logging.root.manager.disable
    logging.disable(logging.INFO)
    try:
        yield
    finally:
        logging.disable(before)
