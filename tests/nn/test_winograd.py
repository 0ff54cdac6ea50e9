"""Winograd's convolution against PyTorch's: values, gradients, what is replaced, and when it steps aside."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from mambaloc.nn import PooledBackbone, winograd
from mambaloc.nn.winograd import WinogradConv2d, _Winograd, use_winograd


@pytest.mark.parametrize("size", [(4, 8), (7, 9), (1, 2)])
@pytest.mark.parametrize("working_bytes", [1, 2**20])
def test_it_is_the_convolution_and_its_gradients(size, working_bytes, monkeypatch):
    monkeypatch.setattr(winograd, "_WORKING_BYTES", working_bytes)  # an image at a time, or all
    torch.manual_seed(0)
    image = torch.randn(3, 2, *size, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(5, 2, 3, 3, dtype=torch.float64, requires_grad=True)
    ours, direct = _Winograd.apply(image, weight), F.conv2d(image, weight, padding=1)
    torch.testing.assert_close(ours, direct)
    grad = torch.randn_like(direct)
    for mine, theirs in zip(*(torch.autograd.grad(y, (image, weight), grad) for y in (ours, direct)), strict=True):
        torch.testing.assert_close(mine, theirs)


def test_in_float32_it_is_near():
    torch.manual_seed(0)
    image, weight = torch.randn(2, 128, 14, 14), torch.randn(128, 128, 3, 3) / 34
    direct = F.conv2d(image.double(), weight.double(), padding=1)
    assert (_Winograd.apply(image, weight) - direct).abs().max() < 3e-5 * direct.abs().max()


@pytest.mark.parametrize("frozen", ["image", "weight"])
def test_what_needs_no_gradient_gets_none(frozen):
    tensors = {"image": torch.randn(1, 2, 4, 4), "weight": torch.randn(2, 2, 3, 3)}
    for name, tensor in tensors.items():
        tensor.requires_grad_(name != frozen)
    _Winograd.apply(*tensors.values()).sum().backward()
    assert {name for name, tensor in tensors.items() if tensor.grad is None} == {frozen}


def test_only_training_uses_it(monkeypatch):
    conv = WinogradConv2d(2, 2, 3, padding=1, bias=False)
    image, calls = torch.randn(1, 2, 4, 4), []
    monkeypatch.setattr(_Winograd, "apply", lambda *tensors: calls.append(1) or F.conv2d(*tensors, padding=1))
    conv(image)
    assert len(calls) == 1
    with torch.no_grad():
        conv(image)
    with torch.autocast("cpu"):
        conv(image)
    conv.eval()(image)
    assert len(calls) == 1


def test_it_replaces_what_gains_and_keeps_names_and_weights():
    others = [
        nn.Conv2d(128, 8, 3, padding=1),
        nn.Conv2d(128, 8, 3, padding=1, stride=2, bias=False),
        nn.Conv2d(128, 8, 1, bias=False),
        nn.Conv2d(128, 128, 3, padding=1, bias=False, groups=2),
        nn.Conv2d(8, 8, 3, padding=1, bias=False),
    ]
    body = nn.Sequential(nn.Conv2d(128, 8, 3, padding=1, bias=False), *others)
    before = dict(body.named_parameters())
    use_winograd(body)
    assert [type(conv) is WinogradConv2d for conv in body] == [True, *[False] * 5]
    assert all(parameter is before[name] for name, parameter in body.named_parameters())
    assert list(before) == list(dict(body.named_parameters()))


def test_a_resnet_trains_through_it():
    backbone = PooledBackbone("resnet18")
    assert sum(isinstance(module, WinogradConv2d) for module in backbone.modules()) == 9
    backbone(torch.rand(2, 3, 32, 32)).sum().backward()
    assert all(parameter.grad is not None for parameter in backbone.parameters())
