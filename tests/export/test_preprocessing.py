"""Resizing and cropping inside a model against OpenCV's."""

import numpy as np
import onnx
import onnxruntime
import pytest

from mambaloc.export.preprocessing import ties_rounded_otherwise, with_preprocessing
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
    ("size", "short_side", "is_exact"),
    [
        ((72, 96), 36, True),
        ((480, 640), 240, True),
        ((480, 640), 120, True),
        ((1080, 1920), 360, True),
        ((480, 640), 108, False),
        ((1080, 1920), 256, False),
        ((3024, 4032), 256, False),
    ],
    ids=["half", "half_vga", "quarter_vga", "third_1080p", "vga", "1080p", "photograph"],
)
def test_levels_are_opencvs(size, short_side, is_exact):
    """Guess: one rule of rounding serves all factors. Wrong: OpenCV rounds halves up at 2, to even at 3 and 4."""
    preprocessing = Preprocessing(short_side, (short_side - 4, short_side))
    image = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    (inside,) = resizing_model(preprocessing).run(None, {"rgb": image})
    levels = np.rint(inside[0].transpose(1, 2, 0) * 255).astype(int)
    expected = preprocessing.apply(image)
    may_differ = ties_rounded_otherwise(image, preprocessing) != expected
    assert may_differ.mean() < 2e-3
    assert not (is_exact and may_differ.any())
    assert np.abs(levels - expected).max() <= 1
    np.testing.assert_array_equal(levels[~may_differ], expected[~may_differ])


def test_ties_are_the_levels_halfway_in_whole_numbers():
    """400 pixels become 90: an old pixel is 9 parts, a new one 40, so a level is a whole number over 1600."""
    overlaps = np.repeat(np.eye(90, dtype=int), 40, axis=1).reshape(90, 400, 9).sum(axis=2)
    image = np.random.default_rng(0).integers(0, 256, (400, 400, 3), dtype=np.uint8)
    parts = np.stack([overlaps @ channel @ overlaps.T for channel in image.astype(int).transpose(2, 0, 1)], axis=2)
    preprocessing = Preprocessing(90, (90, 90))
    rounded = preprocessing.apply(image).astype(int)
    otherwise = ties_rounded_otherwise(image, preprocessing).astype(int)
    is_tie = parts % 1600 == 800
    assert is_tie.sum() > 10
    np.testing.assert_array_equal(rounded != otherwise, is_tie)
    np.testing.assert_array_equal((rounded + otherwise)[is_tie], 2 * (parts // 1600)[is_tie] + 1)


def test_a_power_of_two_has_no_ties():
    image = np.random.default_rng(0).integers(0, 256, (144, 192, 3), dtype=np.uint8)
    preprocessing = Preprocessing(36, (36, 40))
    np.testing.assert_array_equal(ties_rounded_otherwise(image, preprocessing), preprocessing.apply(image))
