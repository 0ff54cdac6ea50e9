"""Published programs: the same function as ours, the same dropout, and a loop that learns."""

import pytest
import torch

from mambaloc.benchmark.clock import PARTS, StepClock
from mambaloc.benchmark.reference import (
    DecodedFrames,
    PublishedAtLoc,
    PublishedLayer,
    PublishedTransPoseNet,
    ReferenceLoop,
)
from mambaloc.data import PoseDataModule
from mambaloc.models import create_model
from mambaloc.models.weights import parameter_count

SMALL = {"dim": 32, "heads": 4, "encoder_layers": 2, "feedforward": 32, "head_hidden": 32}


@pytest.fixture
def data(scenes):
    module = PoseDataModule("7scenes", str(scenes), "heads", 32, 36, validation="sequences", batch_size=4)
    module.setup("fit")
    return module


def same(ours, theirs):
    torch.testing.assert_close(theirs.position_m, ours.position_m, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(theirs.quaternion, ours.quaternion, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("backbone", ["resnet10t", "mobilenetv3_small_050"])
@pytest.mark.parametrize("gis", ["none", "gis"])
def test_published_transposenet_is_the_same_function(backbone, gis):
    torch.manual_seed(0)
    system = create_model("mambaloc", backbone=backbone, gis=gis, image_size=64, **SMALL).eval()
    published = PublishedTransPoseNet(system).eval()
    image = torch.rand(2, 3, 64, 64)
    same(system(image), published(system.network.backbone.normalized(image).contiguous()))


@pytest.mark.parametrize("gis", ["none", "gis"])
def test_published_atloc_is_the_same_function(gis):
    torch.manual_seed(0)
    system = create_model("atloc", backbone="resnet10t", width=32, gis=gis, image_size=64).eval()
    image = torch.rand(2, 3, 64, 64)
    same(system(image), PublishedAtLoc(system).eval()(system.network.backbone.normalized(image).contiguous()))


def test_published_dropout_is_ours():
    ours = create_model("transposenet", backbone="resnet10t", image_size=64, attention_dropout=0.25, **SMALL)
    layers = [layer for layer in PublishedTransPoseNet(ours).modules() if isinstance(layer, PublishedLayer)]
    assert {layer.attention.dropout for layer in layers} == {0.25}
    assert {drop.p for layer in layers for drop in (layer.dropout, layer.dropout1, layer.dropout2)} == {0.1}
    assert PublishedAtLoc(create_model("atloc", backbone="resnet10t", width=32, dropout=0.375)).dropout == 0.375


def test_published_parameters_are_ours_and_those_that_nobody_reads():
    system = create_model("transposenet", image_size=64)
    published = PublishedTransPoseNet(system)
    assert parameter_count(published.encoders) + parameter_count(published.head) == parameter_count(
        system.network
    ) - parameter_count(system.network.backbone)
    published(torch.rand(2, 3, 64, 64)).position_m.sum().backward()
    assert {name for name, parameter in published.backbone.named_parameters() if parameter.grad is None}


def test_reference_decodes_what_the_cache_holds(data):
    """Of one frame in the centre: resized by PIL there, by OpenCV here."""
    frames = DecodedFrames(data, [0.0] * 3, [1.0] * 3, "val")
    image, position_m, quaternion = frames[3]
    batch = data.on_after_batch_transfer(next(iter(data.val_dataloader())), 0)
    assert image.shape == batch.image[3].shape
    assert (image - batch.image[3]).abs().mean() < 0.02
    assert torch.equal(position_m, batch.position_m[3])
    assert torch.equal(quaternion, batch.quaternion[3])


def test_reference_has_our_optimiser(data):
    system = create_model(
        "atloc", backbone="resnet10t", width=32, image_size=32, lr=1e-3, beta2=0.98, weight_decay=0.01
    )
    ours = system.configure_optimizers()["optimizer"].defaults
    theirs = ReferenceLoop(system, data, torch.device("cpu")).optimizer.defaults
    names = ("lr", "betas", "eps")
    assert {name: theirs[name] for name in names} == {name: ours[name] for name in names}
    assert theirs["weight_decay"] == 0.01


def test_reference_learns(data):
    torch.manual_seed(0)
    system = create_model("mambaloc", backbone="test_efficientnet", image_size=32, lr=1e-3, **SMALL)
    clock = StepClock(torch.device("cpu"))
    losses = ReferenceLoop(system, data, torch.device("cpu")).train(48, clock)
    assert len(losses) == 48
    assert sum(losses[-12:]) < 0.6 * sum(losses[:12])
    assert {part: len(seconds) for part, seconds in clock.parts_s.items()} == dict.fromkeys(PARTS, 48)
    assert min(clock.parts_s["forward"]) > 0
