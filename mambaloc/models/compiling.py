"""Training steps through ``torch.compile``."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import nn

from mambaloc.errors import InputError

CompileMode = Literal["default", "reduce-overhead"]


def compile_forward(network: nn.Module, mode: CompileMode, accumulated_batches: int) -> Callable[..., Any]:
    """Compile what a network computes.

    The function, not the module: the state dict keeps its names, and validation, whose predictions outlive the step
    that a CUDA graph overwrites, runs without.

    Args:
        network: stays as it is.
        mode: of ``torch.compile``.
        accumulated_batches: whose gradients are summed.

    Raises:
        InputError: where nothing can compile it, or its mode does not go with summed gradients.
    """
    if "CXX" not in os.environ and not any(map(shutil.which, ("c++", "g++", "clang++", "cl"))):
        raise InputError("model.compile_mode: needs a C++ compiler; install g++, or set it to null")
    if accumulated_batches > 1 and mode == "reduce-overhead":
        raise InputError(
            "model.compile_mode reduce-overhead: a replayed graph overwrites accumulated gradients; "
            "set it to default, or trainer.accumulate_grad_batches to 1"
        )
    return torch.compile(network.forward, mode=mode)
