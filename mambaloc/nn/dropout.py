"""Dropout whose mask is cheap to draw on a CPU."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_PER_DRAW = 4  # chances in the 64 bits of one draw
_CHANCES = 2**16


class Dropout(nn.Dropout):
    """``nn.Dropout``; on a CPU one random number of 64 bits decides on four elements.

    PyTorch draws a number an element there, one after another: a training step of MambaLoc takes 1.06 times as long.
    The probability is rounded to a multiple of 2^-16, and the scale with it, so that the mean stays as it is.

    Shape:
        (*) -> (*).
    """

    def forward(self, input: Tensor) -> Tensor:
        """Zero elements at random and scale the others up while training; change nothing otherwise."""
        dropped = round(self.p * _CHANCES)
        fast = input.device.type == "cpu" and not torch.compiler.is_compiling()  # which knows no random_
        if not (fast and self.training and 0 < dropped < _CHANCES):
            return super().forward(input)
        draws = torch.empty(-(-input.numel() // _PER_DRAW), dtype=torch.int64).random_(-(2**63), None)
        chances = draws.view(torch.int16)[: input.numel()].view(input.shape)
        kept = chances >= dropped - _CHANCES // 2
        return input * kept.to(input.dtype).mul_(_CHANCES / (_CHANCES - dropped))
