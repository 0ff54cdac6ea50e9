"""Radii that hold their share, distances to training images, and models that tell both."""

import copy
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from scipy.spatial.distance import cdist

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.export import contract_of, export_onnx
from mambaloc.export.precision import half_precision
from mambaloc.images import read_image, resized
from mambaloc.models.student import LitStudent
from mambaloc.nn import Backbone, PooledBackbone
from mambaloc.runtime import Localizer
from mambaloc.uncertainty import (
    LEVEL,
    ErrorsByDistance,
    UncertaintyHead,
    conformal_quantile,
    errors_by_distance,
    fit_uncertainty,
    pooled,
    seen_of,
)

SHARED = Path(__file__).parents[2] / "shared"


def student(**kwargs):
    torch.manual_seed(0)
    system = LitStudent(backbone="test_efficientnet", width=16, image_size=(32, 40), **kwargs)
    system.network.head.position_scale.fit(torch.randn(9, 3))
    return system


def scene(scenes, **kwargs):
    return PoseDataModule("7scenes", str(scenes), "heads", image_size=(32, 40), short_side=36, **kwargs)


def as_if_trained(system, data):
    """A system whose provenance says that it was trained on these frames."""
    data.setup("fit")
    system.provenance = {"data": data.describe()}
    return system, data


def head_of(held_out, level=LEVEL):
    head = UncertaintyHead(torch.randn(8, 4, generator=torch.Generator().manual_seed(0)))
    head.calibrate(held_out, level)
    return head


# --- radii -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "level"), [(9, 0.9), (19, 0.9), (20, 0.9), (99, 0.99), (57, 0.5)])
def test_the_quantile_is_numpys_of_one_more_value(count, level):
    values = np.random.default_rng(count).exponential(size=count)
    expected = np.quantile(np.append(values, np.inf), level, method="inverted_cdf")
    assert conformal_quantile(values, level) == expected


def test_too_few_values_tell_nothing():
    assert conformal_quantile(np.arange(9.0), 0.9) == 8
    with pytest.raises(ValueError, match="8 values are too few for a 90% quantile"):
        conformal_quantile(np.arange(8.0), 0.9)


def draw(count, generator):
    """Errors that grow with the distance in position, and not at all in rotation."""
    distance = 1 + 4 * torch.rand(count, generator=generator)
    position_m = (0.1 + 0.2 * distance) * torch.rand(count, generator=generator)
    return ErrorsByDistance(distance, position_m, 8 * torch.rand(count, generator=generator))


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_the_share_within_is_the_level(level):
    """Over many draws of held-out frames, as the theory has it: no less, and no more than one frame's share above."""
    generator, within, count = torch.Generator().manual_seed(0), [], 60
    for _ in range(300):
        head, test = head_of(draw(count, generator), level), draw(200, generator)
        metres, degrees = head.radii(test.distance).unbind(-1)
        within.append(
            [(test.position_error_m <= metres).float().mean(), (test.rotation_error_deg <= degrees).float().mean()]
        )
    shares = np.array(within).mean(axis=0)
    assert np.all(shares > level - 0.02)  # the two numbers of a line were fitted to the same frames
    assert np.all(shares < level + 1 / count + 0.02)


def test_radii_grow_where_errors_do_and_never_fall():
    generator = torch.Generator().manual_seed(1)
    head = head_of(draw(2000, generator))
    near, far = head.radii(torch.tensor([1.0, 5.0]))
    assert far[0] / near[0] == pytest.approx((0.1 + 0.2 * 5) / (0.1 + 0.2), rel=0.1)
    assert far[1] / near[1] == pytest.approx(1, abs=0.1)
    falling = torch.linspace(1, 5, 100)
    head = head_of(ErrorsByDistance(falling, 1 / falling, 1 / falling))
    assert torch.all(head.slopes == 0)


def test_a_radius_is_never_nothing():
    """Errors in proportion to the distance less one: a line through them would be negative near a training image."""
    distance = torch.linspace(1, 5, 100)
    head = head_of(ErrorsByDistance(distance, distance - 1, distance - 1))
    assert torch.all(head.intercepts > 0)
    assert torch.all(head.slopes > 0)


def test_copies_of_training_frames_leave_finite_numbers():
    nothing = torch.zeros(20)
    metres, degrees, unfamiliarity = head_of(ErrorsByDistance(nothing, nothing, nothing))(torch.ones(1, 4))
    assert torch.isfinite(torch.stack((metres, degrees, unfamiliarity))).all()
    assert unfamiliarity > 1


def test_familiar_is_what_nearly_all_held_out_frames_are():
    distance = torch.arange(1.0, 201)
    assert head_of(ErrorsByDistance(distance, distance, distance)).familiar == 199  # the 199th of 201 is 99 %
    assert head_of(ErrorsByDistance(distance[:20], distance[:20], distance[:20])).familiar == 20


# --- distances -------------------------------------------------------------------------------------------------------


def test_distances_against_scipy():
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor([1.0, 5.0, 0.2, 0.0, 2.0])
    training, seen = (torch.randn(n, 5, generator=generator) * spread for n in (30, 12))
    training[:, 3], seen[:, 3] = 2.0, 2.5  # a feature that training never varied
    variances = training.numpy().astype(float).var(axis=0)
    variances = np.maximum(variances, (0.1 * np.sqrt(variances).mean()) ** 2)
    expected = cdist(seen.double(), training.double(), "seuclidean", V=variances).min(axis=1)
    np.testing.assert_allclose(UncertaintyHead(training).distance(seen), expected, rtol=1e-4)


def test_training_images_are_no_distance_from_themselves():
    training = torch.randn(30, 5, generator=torch.Generator().manual_seed(0))
    assert torch.equal(UncertaintyHead(training).distance(training), torch.zeros(30))


@torch.no_grad()
def test_what_backbones_see_of_an_image():
    image = torch.rand(2, 3, 64, 64)
    maps = Backbone("resnet10t", strides=(8, 16)).eval()(image)
    expected = torch.cat([each.flatten(2).mean(-1) for each in maps], dim=1)
    torch.testing.assert_close(pooled(maps), expected)
    feature = PooledBackbone("resnet10t").eval()(image)
    assert pooled(feature) is feature


# --- a trained system ------------------------------------------------------------------------------------------------


def test_held_out_frames_set_the_radii(scenes):
    system, data = as_if_trained(student(), scene(scenes))
    before, state = system.training, copy.deepcopy(system.state_dict())
    head = fit_uncertainty(system, data)
    assert head.describe() == {"level": 0.9, "held_out_frames": 12}
    assert system.training == before
    assert all(torch.equal(state[name], value) for name, value in system.state_dict().items())

    found = errors_by_distance(system.network.eval(), head, data, "val")
    for errors, radius in zip(
        (found.position_error_m, found.rotation_error_deg), head.radii(found.distance).unbind(-1), strict=True
    ):
        assert (errors <= radius * (1 + 1e-5)).sum() == 12  # ceil(13 * 0.9): the largest ratio of all
    images = torch.cat([batch.image for batch in data.batches("train")])
    assert torch.equal(head.references, seen_of(system.network, [images]) * head.scale)


def test_errors_are_those_of_an_evaluation(scenes):
    system, data = as_if_trained(student().eval(), scene(scenes))
    head = fit_uncertainty(system, data)
    table = localize_test_frames(system, data, "cpu")
    found = errors_by_distance(system.network.eval(), head, data, "test")
    torch.testing.assert_close(found.position_error_m, table.position_error_m, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found.rotation_error_deg, table.rotation_error_deg, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"validation": "none"}, "data.validation none: .* needs held-out frames; train with auto"),
        ({"validation": "test_set"}, "data.validation test_set: .* needs held-out frames"),
        (
            {"validation": "block", "val_fraction": 0.1, "val_gap": 1},
            "data.validation block: 2 frames are held out, but calibrating the uncertainty takes 9",
        ),
    ],
)
def test_without_held_out_frames_nothing_is_told(scenes, changed, message):
    with pytest.raises(InputError, match=message):
        fit_uncertainty(*as_if_trained(student(), scene(scenes, **changed)))


def test_frames_that_were_trained_on_count_for_nothing(scenes):
    system, data = as_if_trained(student(), scene(scenes))
    fit_uncertainty(system, data)
    with pytest.raises(InputError, match="heads: the system was trained on other or unknown frames"):
        fit_uncertainty(system, scene(scenes, validation="block", val_fraction=0.4, val_gap=1))
    with pytest.raises(InputError, match=r"on other or unknown frames, .*; give a checkpoint's own"):
        fit_uncertainty(student(), data)


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared beside the repository")
@torch.inference_mode()
def test_pictures_of_another_place_are_unfamiliar():
    """A kitchen, and 50 images of a fox on a table, to a pretrained backbone whose heads know neither."""
    weights, root = SHARED / "weights/mobilenetv2_100.imagenet_tf2ptq.safetensors", SHARED / "data/7scenes_blocks"
    backbone = {"backbone_args": {"pad_type": "same"}, "pixel_mean": (0.5,) * 3, "pixel_std": (0.5,) * 3}
    system = LitStudent(
        backbone="mobilenetv2_100", backbone_weights=str(weights), image_size=(96, 128), **backbone
    ).eval()
    scene = {"image_size": (96, 128), "short_side": 108, "keep_every": 4}
    data = PoseDataModule("7scenes", str(root), "redkitchen", validation="sequences", **scene)
    head = fit_uncertainty(*as_if_trained(system, data))
    data.setup("test")
    elsewhere = [resized(read_image(path), 128)[:96] for path in sorted((SHARED / "data/fox/images").glob("*.jpg"))]
    images = (torch.from_numpy(each.transpose(2, 0, 1).copy())[None].float() / 255 for each in elsewhere)
    *_, there = head(seen_of(system.network, images))
    *_, here = head(seen_of(system.network, (batch.image for batch in data.batches("test"))))
    assert (there > 1).float().mean() == 1
    assert (here > 1).float().mean() < 0.2
    assert there.min() > here.median()


# --- models ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def exported(scenes, tmp_path_factory):
    system, data = as_if_trained(student().eval(), scene(scenes))
    head, path = fit_uncertainty(system, data), tmp_path_factory.mktemp("unsure") / "model.onnx"
    parity = export_onnx(system, path, contract_of(system, data.hparams, head), head)
    assert parity.uncertainty < 1e-3
    data.setup("test")
    return system, data, head, path


@torch.no_grad()
def test_the_localizer_tells_what_the_head_tells(exported):
    system, data, head, path = exported
    localizer = Localizer(path, 1)
    assert localizer.contract.uncertainty == {"level": 0.9, "held_out_frames": 12}
    for frame, batch in zip(data.frames("test").image_paths, data.batches("test", size=1), strict=True):
        metres, degrees, unfamiliarity = head(pooled(system.network.backbone(batch.image)))
        found = localizer.localize(frame)
        assert found.position_radius_m == pytest.approx(metres.item(), rel=1e-3)
        assert found.rotation_radius_deg == pytest.approx(degrees.item(), rel=1e-3)
        assert found.unfamiliarity == pytest.approx(unfamiliarity.item(), rel=1e-3)
        assert found.is_unfamiliar == (unfamiliarity > 1)


def test_half_precision_tells_nearly_the_same(exported, tmp_path):
    _, data, _, path = exported
    model = onnx.load(path)
    half = half_precision(model)
    weights = {each.name: each.data_type for each in half.graph.initializer if len(each.dims) == 4}
    assert onnx.TensorProto.FLOAT not in weights.values()  # the way to the radii keeps no convolution exact
    onnx.save(half, tmp_path / "half.onnx")
    for frame in data.frames("test").image_paths:
        exact, rounded = (Localizer(each, 1).localize(frame) for each in (path, tmp_path / "half.onnx"))
        assert rounded.position_radius_m == pytest.approx(exact.position_radius_m, rel=0.02)
        assert rounded.unfamiliarity == pytest.approx(exact.unfamiliarity, rel=0.02)


def test_a_contract_of_another_model_is_refused(exported, tmp_path):
    system, data, _, path = exported
    model = onnx.load(path)
    for entry in model.metadata_props:
        entry.value = contract_of(system, data.hparams).to_json()
    onnx.save(model, tmp_path / "model.onnx")
    with pytest.raises(
        InputError, match=r"outputs \['position_m', .* do not match its contract\. Export the model again"
    ):
        Localizer(tmp_path / "model.onnx")


def test_a_model_that_cannot_tell_is_never_in_doubt(exported, bundle_of_tensors):
    _, data, _, _ = exported
    found = Localizer(bundle_of_tensors / "model.onnx", 1).localize(data.frames("test").image_paths[0])
    assert (found.position_radius_m, found.rotation_radius_deg, found.unfamiliarity) == (None, None, None)
    assert not found.is_unfamiliar
