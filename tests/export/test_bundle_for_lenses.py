"""Bundles of a system that takes intrinsics."""

import json

import cv2
import numpy as np
import onnxruntime
import pytest

from mambaloc.runtime import Localizer
from mambaloc.runtime.bundle import verify_bundle
from mambaloc.runtime.rotations import rotation_error_deg

pytestmark = pytest.mark.slow
kinds = pytest.mark.parametrize("kind", ["tensors", "pictures"])
MODELS = ["model.onnx", "model.ort"]
RENDERED = [[144, 0, 79.5], [0, 144, 59.5], [0, 0, 1]]
"""The camera of the den's frames of 160x120."""


@pytest.fixture
def bundle(bundles_for_lenses, kind):
    return bundles_for_lenses / kind


@kinds
def test_every_model_finds_what_pytorch_finds_through_either_lens(bundle):
    exact, ort = verify_bundle(bundle)
    assert [each.file for each in (exact, ort)] == MODELS
    assert all(each.within for each in (exact, ort))
    assert max(exact.position_mm, ort.position_mm) < 1
    assert max(exact.rotation_deg, ort.rotation_deg) < 0.05


@kinds
def test_a_bundle_states_its_cameras(bundle):
    contract = json.loads((bundle / "contract.json").read_text())
    scale = 72 / 120  # 160x120 becomes 96x72, of which rows 4 to 67 are taken
    trained = [[144 * scale, 0, 47.5], [0, 144 * scale, 31.5], [0, 0, 1]]
    np.testing.assert_allclose(contract["intrinsics"], trained, rtol=1e-5)
    *frames, other = contract["frames"]
    assert len(frames) == 5
    for frame in frames:
        assert frame["intrinsics"] == RENDERED
    picture, whole = (cv2.imread(str(bundle / each["file"])) for each in (other, frames[0]))
    np.testing.assert_array_equal(picture, whole[:, 20:])
    assert other["intrinsics"] == [[144, 0, 59.5], [0, 144, 59.5], [0, 0, 1]]


@kinds
@pytest.mark.parametrize("model", MODELS)
def test_the_input_is_required_so_that_every_runtime_uses_it(bundle, model):
    session = onnxruntime.InferenceSession(str(bundle / model), providers=["CPUExecutionProvider"])
    first, intrinsics = session.get_inputs()
    assert (intrinsics.name, intrinsics.type, intrinsics.shape[-2:]) == ("intrinsics", "tensor(float)", [3, 3])
    assert not session.get_overridable_initializers()
    told = json.loads((bundle / "contract.json").read_text())["intrinsics_input"]
    assert (told["name"], told["in_pixels_of"]) == (intrinsics.name, first.name)


@kinds
def test_the_training_camera_is_the_default(bundle):
    localizer, frame = Localizer(bundle), bundle / "frames/2.png"
    stated, unstated = localizer.localize(frame, RENDERED), localizer.localize(frame)
    np.testing.assert_allclose(unstated.position_m, stated.position_m, atol=1e-4)
    assert rotation_error_deg(unstated.quaternion, stated.quaternion) < 0.01


@kinds
def test_a_camera_that_looks_elsewhere_is_turned_by_as_much(bundle):
    """With the principal point moved, every ray turns, and the pose that is solved from them turns back."""
    localizer, frame = Localizer(bundle), cv2.imread(str(bundle / "frames/2.png"))[..., ::-1]
    moved = [[144, 0, 79.5 + 144 * np.tan(np.radians(10))], [0, 144, 59.5], [0, 0, 1]]
    found, turned = (localizer.localize(frame, intrinsics) for intrinsics in (RENDERED, moved))
    np.testing.assert_allclose(turned.position_m, found.position_m, atol=1e-5)  # votes know no camera
    assert rotation_error_deg(turned.quaternion, found.quaternion) == pytest.approx(10, abs=2)
