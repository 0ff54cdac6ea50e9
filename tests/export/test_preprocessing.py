"""Resizing and cropping inside a model against OpenCV's."""

import numpy as np
import onnx
import onnxruntime
import pytest

from mambaloc.export.preprocessing import with_preprocessing
from mambaloc.runtime.contract import Preprocessing


def resizing_model(preprocessing: Preprocessing) -> onnxruntime.InferenceSession:
    height, width = preprocessing.crop
    network = onnx.parser.parse_model(f"""
        <ir_version: 10, opset_import: ["": 18]>
        network (float[1, 3, {height}, {width}] image) => (float[1, 3, {height}, {width}] same)
        {{ same = Identity(image) }}
    """)
    model = with_preprocessing(network, preprocessing)
    onnx.checker.check_model(model)
    return onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])


@pytest.mark.parametrize(
    ("size", "short_side", "worst_share"),
    [((72, 96), 36, 0), ((480, 640), 240, 0), ((480, 640), 120, 0), ((1080, 1920), 360, 0), ((1080, 1920), 256, 2e-3)],
    ids=["half", "half_vga", "quarter_vga", "third_1080p", "no_whole_factor"],
)
def test_levels_are_opencvs(size, short_side, worst_share):
    """Guess: one rule of rounding serves all factors. Wrong: OpenCV rounds halves up at 2, to even at 3 and 4."""
    preprocessing = Preprocessing(short_side, (short_side - 4, short_side))
    image = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    (inside,) = resizing_model(preprocessing).run(None, {"rgb": image})
    levels = np.rint(inside[0].transpose(1, 2, 0) * 255).astype(int)
    off = np.abs(levels - preprocessing.apply(image))
    assert off.max() <= 1
    assert (off > 0).mean() <= worst_share
