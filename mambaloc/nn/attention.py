"""Scaled dot-product attention, with dropout on its weights where that is asked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from mambaloc.nn.dropout import CHANCES, kept_masks

_BLOCK_BYTES = 2**20  # of attention weights at a time: they stay in the cache


def attend(query_BHND: Tensor, key_BHMD: Tensor, value_BHMD: Tensor, dropout: float = 0.0) -> Tensor:
    """``F.scaled_dot_product_attention``; on a CPU, dropout costs less time and next to no memory.

    PyTorch's fused kernel on a CPU has no dropout; its other one keeps the weights of all heads, several times over,
    for the backward pass. Here they are computed a block of rows at a time, and again in the backward pass. The
    probability is rounded to a multiple of 2^-16, and the scale with it.

    Shape:
        (B, heads, N, D), (B, heads, M, D), (B, heads, M, D) -> (B, heads, N, D).
    """
    dropped = round(dropout * CHANCES)
    ours = query_BHND.device.type == "cpu" and 0 < dropped < CHANCES and not torch.is_autocast_enabled("cpu")
    if ours and not torch.compiler.is_compiling():
        return _DroppedAttention.apply(query_BHND, key_BHMD, value_BHMD, dropped)
    return F.scaled_dot_product_attention(query_BHND, key_BHMD, value_BHMD, dropout_p=dropout)


class _DroppedAttention(torch.autograd.Function):
    """Keeps its inputs, its output and a seed; weights and masks are made by blocks, and again in ``backward``."""

    @staticmethod
    def forward(ctx: Any, query_BHND: Tensor, key_BHMD: Tensor, value_BHMD: Tensor, dropped: int) -> Tensor:
        ctx.seed, ctx.dropped = int(torch.randint(2**63 - 1, ())), dropped
        ctx.scale, ctx.kept_scale = query_BHND.shape[-1] ** -0.5, CHANCES / (CHANCES - dropped)
        batch, heads, count, _ = query_BHND.shape
        result_BHND = query_BHND.new_empty(batch, count, heads, value_BHMD.shape[-1]).transpose(
            1, 2
        )  # heads side by side, as read next
        by_row, whole = (query_BHND * ctx.scale, result_BHND), (key_BHMD, value_BHMD * ctx.kept_scale)
        for rows, (key, value), (scores, weights, kept) in _blocks(ctx, by_row, whole):
            query, result = rows
            torch.mm(query, key.T, out=scores)
            torch.softmax(scores, -1, out=weights)
            torch.mm(weights.mul_(kept), value, out=result)
        ctx.save_for_backward(query_BHND, key_BHMD, value_BHMD, result_BHND)
        return result_BHND

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_BHND: Tensor) -> tuple[Tensor | None, ...]:
        query_BHND, key_BHMD, value_BHMD, result_BHND = ctx.saved_tensors
        grad_query, grad_key, grad_value = map(torch.zeros_like, (query_BHND, key_BHMD, value_BHMD))
        mean_BHN1 = (grad_BHND * result_BHND).sum(-1, keepdim=True)  # of a row's gradients, by its weights
        by_row = (query_BHND * ctx.scale, grad_BHND * ctx.kept_scale, mean_BHN1, grad_query)
        for rows, whole, (scores, weights, kept) in _blocks(ctx, by_row, (key_BHMD, value_BHMD, grad_key, grad_value)):
            (query, grad, mean, of_query), (key, value, of_key, of_value) = rows, whole
            torch.mm(query, key.T, out=scores)
            torch.softmax(scores, -1, out=weights)
            of_value.addmm_(torch.mul(weights, kept, out=scores).T, grad)
            torch.mm(grad, value.T, out=scores)
            scores.mul_(kept).sub_(mean).mul_(weights)
            torch.mm(scores, key, out=of_query)
            of_key.addmm_(scores.T, query)
        return grad_query.mul_(ctx.scale), grad_key, grad_value, None


def _blocks(ctx: Any, by_row_BHNX: tuple[Tensor, ...], whole_BHMX: tuple[Tensor, ...]) -> Iterator[Any]:
    """Go through rows of each head of each image: rows, the head's whole tensors, and three matrices to work in.

    The third matrix holds 1 where a weight is kept and 0 where it is dropped.
    """
    (rows, columns), like = (by_row_BHNX[0].shape[2], whole_BHMX[0].shape[2]), by_row_BHNX[0]
    height = -(-rows // -(-rows * columns * like.element_size() // _BLOCK_BYTES))
    scores, weights = like.new_empty(2, height, columns)
    masks = kept_masks(like.new_empty(height, columns), ctx.dropped, ctx.seed)
    for of_image in zip(*by_row_BHNX, *whole_BHMX, strict=True):
        for of_head in zip(*of_image, strict=True):
            of_rows, of_whole = of_head[: len(by_row_BHNX)], of_head[len(by_row_BHNX) :]
            for block in zip(*(tensor.split(height) for tensor in of_rows), strict=True):
                count = len(block[0])
                yield block, of_whole, (scores[:count], weights[:count], next(masks)[:count])
