"""Eight-bit integers: the same network a quarter of the size, of value only if the poses stay."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process
from torch import Tensor

from mambaloc.data import PoseDataModule
from mambaloc.metrics import error_table, summarize
from mambaloc.runtime.contract import IMAGE_INPUT, INTRINSICS_INPUT
from mambaloc.types import PoseBatch, PosePrediction

LARGEST_LOSS = 0.1
"""Share of a median error that eight bits may add to it."""

_PRODUCTS = ("Conv", "MatMul", "Gemm")  # what becomes integer products; all else stays in floating point
_CLIPS = ("Clip", "Relu")  # after a product they go into its scale, which then covers no value that they cut off
_CALIBRATION_FRAMES = 64


@dataclass(frozen=True)
class QuantizedModel:
    """A quantised network and what it lost.

    Args:
        model: the network.
        kind: ``all layers``, or ``mixed``: the first layer, the heads and squeeze-excitation's gates in float32.
        position_error_m: median over the test frames.
        rotation_error_deg: median rotation error on the same frames.
        loss: by how much of itself the median error grew, the larger of position's and rotation's.
        frames: test frames that this was measured, and decided, on.
    """

    model: onnx.ModelProto
    kind: str
    position_error_m: float
    rotation_error_deg: float
    loss: float
    frames: int

    @property
    def within_tolerance(self) -> bool:
        """Whether it lost little enough to be of use."""
        return self.loss < LARGEST_LOSS  # not where it is NaN

    def __str__(self) -> str:
        errors = f"median {self.position_error_m:.3f} m and {self.rotation_error_deg:.2f}° on {self.frames} test frames"
        summary = f"int8 ({self.kind}): {errors}, {self.loss:+.1%} on float32's at most"
        return (
            summary
            if self.within_tolerance
            else f"{summary}; {LARGEST_LOSS:.0%} is allowed, so it was left out; use fp16"
        )


def eight_bit(model: onnx.ModelProto, data: PoseDataModule) -> QuantizedModel:
    """Quantise a network after training: all layers if the errors allow it, else without the most sensitive ones.

    Args:
        model: a network as :func:`~mambaloc.export.export_onnx` writes it.
        data: what it was trained with: training frames to calibrate on, test frames to measure on.

    Raises:
        InputError: where the frames are not there.
    """
    data.setup("fit")
    data.setup("test")
    prepared = _prepared(model)
    before = median_errors(model, data)
    batches, count = _calibration_batches(data), len(data.frames("test"))
    for kind, kept in (("all layers", []), ("mixed", sensitive_nodes(prepared.graph))):
        quantized = _quantized(prepared, batches, kept)
        after = median_errors(quantized, data)
        position_m, rotation_deg = (after[name] for name in ("position_error_m", "rotation_error_deg"))
        ratios = [after[name] / max(before[name], 1e-9) for name in ("position_error_m", "rotation_error_deg")]
        loss = float(np.max(ratios)) - 1  # NaN stays NaN
        found = QuantizedModel(quantized, kind, position_m, rotation_deg, loss, count)
        if found.within_tolerance:
            break
    return found


def median_errors(model: onnx.ModelProto, data: PoseDataModule) -> dict[str, float]:
    """Errors of a network in ONNX Runtime over the test frames, as :func:`mambaloc.metrics.summarize` returns them."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])

    names = [tensor.name for tensor in session.get_inputs()]

    def localize(image: Tensor, intrinsics: Tensor | None) -> PosePrediction:
        given = {IMAGE_INPUT: image.numpy(), INTRINSICS_INPUT: None if intrinsics is None else intrinsics.numpy()}
        position_m, quaternion, *_ = session.run(None, {name: given[name] for name in names})
        return PosePrediction(torch.from_numpy(position_m), torch.from_numpy(quaternion))

    return summarize(error_table(localize, data.batches("test")))


def sensitive_nodes(graph: onnx.GraphProto) -> list[str]:
    """Names of the layers that eight bits hurt most: the first, the heads, and squeeze-excitation's gates."""
    layers = [node for node in graph.node if node.op_type in _PRODUCTS]
    gates = [node for node in layers if _is_of_one_pixel(graph, node)]
    heads = [node for node in layers if node.op_type != "Conv"]
    return [node.name for node in (layers[0], *gates, *heads)]


def _is_of_one_pixel(graph: onnx.GraphProto, node: onnx.NodeProto) -> bool:
    shapes = {value.name: value.type.tensor_type.shape.dim for value in graph.value_info}
    return node.op_type == "Conv" and [d.dim_value for d in shapes.get(node.output[0], [])][2:] == [1, 1]


def _prepared(model: onnx.ModelProto) -> onnx.ModelProto:
    """Fold and fuse what would otherwise be rounded twice: batch normalisation into convolutions."""
    with TemporaryDirectory() as folder:
        source, out = Path(folder, "as_exported.onnx"), Path(folder, "prepared.onnx")
        onnx.save(model, source)
        quant_pre_process(source, out, skip_symbolic_shape=True)
        return onnx.load(out)


def _calibration_batches(data: PoseDataModule) -> list[PoseBatch]:
    """Training frames evenly spread, one at a time."""
    rows = data.frames("train").evenly_spread(_CALIBRATION_FRAMES)
    return list(data.batches("train", rows, size=1))


def _quantized(model: onnx.ModelProto, batches: Sequence[PoseBatch], kept: Sequence[str]) -> onnx.ModelProto:
    """Static QDQ: unsigned activations, signed weights with a scale for each channel.

    All eight bits of a weight: in seven, which ONNX Runtime advises for x86 processors without VNNI, MobileNetV2's
    poses were two to four times as far from float32's, on such a processor.
    """
    with TemporaryDirectory() as folder:
        source, out = Path(folder, "float.onnx"), Path(folder, "int8.onnx")
        onnx.save(model, source)
        before = logging.root.manager.disable
        logging.disable(logging.WARNING)  # it asks for the preparation that was done
        try:
            quantize_static(
                source,
                out,
                _Frames(batches, [tensor.name for tensor in model.graph.input]),
                quant_format=QuantFormat.QDQ,
                op_types_to_quantize=[*_PRODUCTS, *_CLIPS],
                per_channel=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                nodes_to_exclude=list(kept),
            )
        finally:
            logging.disable(before)
        return onnx.load(out)


class _Frames(CalibrationDataReader):
    """What a model takes of each batch: its inputs are named as a batch's fields."""

    def __init__(self, batches: Sequence[PoseBatch], names: Sequence[str]) -> None:
        self._left, self._names = iter(batches), names

    def get_next(self) -> dict[str, Any] | None:
        """Inputs of one batch, or None after the last."""
        batch = next(self._left, None)
        return None if batch is None else {name: getattr(batch, name).numpy() for name in self._names}
