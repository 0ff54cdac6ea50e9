"""Pooling before rectifying against PyTorch's own order: values, gradients, and what is kept between the passes."""

import pytest
import torch
from torch import nn

from mambaloc.nn import Backbone, PooledBackbone
from mambaloc.nn.pooling import ReLUMaxPool2d


@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("options", [(3, 2, 1), (2, 2, 0), ((3, 2), (1, 2), (1, 0))])
def test_values_and_gradients_are_pytorchs(options, memory_format):
    torch.manual_seed(0)
    image = torch.randn(2, 3, 9, 12).sub_(0.8).contiguous(memory_format=memory_format)  # windows without any positive
    mine, theirs = (image.clone().requires_grad_() for _ in range(2))
    pooled, expected = ReLUMaxPool2d(*options)(mine), nn.MaxPool2d(*options)(theirs.relu())
    assert torch.equal(pooled, expected)
    assert (expected == 0).any()
    grad = torch.randn_like(expected)
    pooled.backward(grad)
    expected.backward(grad)
    assert torch.equal(mine.grad, theirs.grad)


def test_less_is_kept():
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t.nbytes) or t, lambda t: t):
        ReLUMaxPool2d(3, 2, 1)(torch.randn(2, 4, 16, 16, requires_grad=True))
    assert sum(kept) == 2 * 4 * 8 * 8 * (4 + 4)  # values and places


def test_only_training_pools_first():
    pool, image = ReLUMaxPool2d(3, 2, 1).eval(), torch.randn(1, 2, 8, 8, requires_grad=True)
    assert type(pool(image).grad_fn).__name__ == "MaxPool2DWithIndicesBackward0"


def test_a_resnet_trains_through_it():
    torch.manual_seed(0)
    backbone = PooledBackbone("resnet18")
    assert isinstance(backbone.body.maxpool, ReLUMaxPool2d)
    image = torch.rand(2, 3, 32, 32)
    ours = backbone(image)
    grads = torch.autograd.grad(ours.sum(), [backbone.body.conv1.weight])
    backbone.body.act1, backbone.body.maxpool = nn.ReLU(), nn.MaxPool2d(3, 2, 1)
    theirs = backbone(image)
    assert torch.equal(ours, theirs)
    torch.testing.assert_close(grads, torch.autograd.grad(theirs.sum(), [backbone.body.conv1.weight]))


def test_a_map_at_stride_2_is_rectified():
    at_2, at_4 = (Backbone("resnet18", strides)(torch.rand(1, 3, 32, 32))[0] for strides in ((2, 8), (4, 8)))
    assert at_2.min() == 0
    assert at_4.min() == 0
    assert at_2.shape[-1] == 2 * at_4.shape[-1]
