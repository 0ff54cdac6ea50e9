"""Stages of a backbone that are computed again in the backward pass, not kept for it (Chen et al. 2016)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.utils.checkpoint import checkpoint

from mambaloc.errors import InputError


class RecomputedSequential(nn.Sequential):
    """``nn.Sequential`` of which a training step keeps the input alone; the same values, gradients and statistics."""

    def forward(self, input: Any) -> Any:
        """Compute, and forget what happened inside."""
        if not self.training or not torch.is_grad_enabled() or torch.compiler.is_compiling():
            return super().forward(input)
        return checkpoint(
            super().forward, input, use_reentrant=False, context_fn=lambda: (nullcontext(), _statistics_kept(self))
        )


def recompute_stages(model: Any, name: str, count: int) -> None:
    """Let the first stages of a timm model be computed again; parameters and names stay.

    Raises:
        InputError: where the model has fewer.
    """
    modules = dict(model.named_modules())
    names = [stage["module"] for stage in getattr(model, "feature_info", [])]
    stages = [modules[each] for each in names if type(modules.get(each)) is nn.Sequential]
    if not 0 <= count <= len(stages):
        raise InputError(
            f"model.recomputed_stages {count}: {name} has {len(stages)}. Choose one of 0 to {len(stages)}."
        )
    for stage in stages[:count]:
        stage.__class__ = RecomputedSequential


@contextmanager
def _statistics_kept(module: nn.Module) -> Iterator[None]:
    """Let batch norms update copies of their running statistics, which the first pass has updated."""
    norms = [each for each in module.modules() if isinstance(each, _BatchNorm)]
    kept = [dict(norm._buffers) for norm in norms]
    try:
        for norm, buffers in zip(norms, kept, strict=True):
            norm._buffers.update({name: None if each is None else each.clone() for name, each in buffers.items()})
        yield
    finally:
        for norm, buffers in zip(norms, kept, strict=True):
            norm._buffers.update(buffers)
