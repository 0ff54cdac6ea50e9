"""Max pooling of rectified values, which keeps less for the backward pass."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from timm.models import ResNet
from torch import Tensor, nn
from torch.autograd.function import once_differentiable


class ReLUMaxPool2d(nn.MaxPool2d):
    """``nn.MaxPool2d`` of ``relu(x)``.

    Training on a CPU pools first, which gives the same values and gradients, and keeps the pooled values and where they
    come from. PyTorch keeps the rectified image besides, as large as any tensor of a ResNet, and places of 64 bits.

    Shape:
        (B, C, H, W) -> (B, C, h, w).
    """

    def forward(self, input: Tensor) -> Tensor:
        """Rectify and pool."""
        trains = self.training and torch.is_grad_enabled() and not torch.compiler.is_compiling()
        if trains and input.device.type == "cpu":
            options = (self.kernel_size, self.stride, self.padding, self.dilation, self.ceil_mode)
            return _PooledFirst.apply(input, options)
        return super().forward(F.relu(input))


def pool_before_relu(body: nn.Module) -> None:
    """Let a ResNet's first pooling rectify, too; parameters and names stay."""
    if isinstance(body, ResNet) and type(body.act1) is nn.ReLU and type(body.maxpool) is nn.MaxPool2d:
        pool: Any = body.maxpool
        body.act1 = nn.Identity()
        body.maxpool = ReLUMaxPool2d(
            pool.kernel_size, pool.stride, pool.padding, pool.dilation, ceil_mode=pool.ceil_mode
        )


class _PooledFirst(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image_BCHW: Tensor, options: tuple[Any, ...]) -> Tensor:
        kernel, stride, padding, dilation, ceil = options
        pooled, places = F.max_pool2d(image_BCHW, kernel, stride, padding, dilation, ceil, return_indices=True)
        ctx.options, ctx.shape = options, image_BCHW.shape
        ctx.save_for_backward(pooled.relu_(), places.int())
        return pooled

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_BChw: Tensor) -> tuple[Tensor, None]:
        pooled_BChw, places_BChw = ctx.saved_tensors
        kernel, stride, padding, dilation, ceil = ([each, each] if type(each) is int else each for each in ctx.options)
        grad_BCHW = grad_BChw.new_empty(ctx.shape).contiguous(memory_format=torch.channels_last)
        torch.ops.aten.max_pool2d_with_indices_backward.grad_input(
            grad_BChw * (pooled_BChw > 0),
            grad_BCHW,  # in the image's place, of which only the shape is read
            *(kernel, stride, padding, dilation, ceil),
            places_BChw.long(),
            grad_input=grad_BCHW,
        )
        return grad_BCHW, None
