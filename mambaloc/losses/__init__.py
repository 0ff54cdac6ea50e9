"""Pose losses, chosen by name so that every hyperparameter stays plain."""

from __future__ import annotations

from typing import Any

from torch import nn

from mambaloc.errors import InputError
from mambaloc.losses.cells import CellWeights
from mambaloc.losses.log_quaternion import LogQuaternionWeights, RelativeLogQuaternionWeights
from mambaloc.losses.reprojection import Reprojection
from mambaloc.losses.soft_targets import Soft, SoftTargets, cosine_distance, softened_kl
from mambaloc.losses.weighted import FixedWeights, LearnedWeights

LOSSES: dict[str, type[nn.Module]] = {
    "learned_weights": LearnedWeights,
    "fixed_weights": FixedWeights,
    "log_quaternion": LogQuaternionWeights,
    "relative_log_quaternion": RelativeLogQuaternionWeights,
    "reprojection": Reprojection,
    "cells": CellWeights,
}


def build_loss(name: str, args: dict[str, Any] | None = None) -> nn.Module:
    """Build the loss of a name with its arguments.

    Raises:
        InputError: for an unknown name or an argument that the loss does not take.
    """
    if name not in LOSSES:
        raise InputError(f"unknown loss {name!r}; choose one of {', '.join(LOSSES)}")
    try:
        return LOSSES[name](**(args or {}))
    except (TypeError, ValueError) as error:
        raise InputError(f"loss_args {args}: {name} does not take them ({error})") from None


__all__ = [
    "LOSSES",
    "CellWeights",
    "FixedWeights",
    "LearnedWeights",
    "LogQuaternionWeights",
    "RelativeLogQuaternionWeights",
    "Reprojection",
    "Soft",
    "SoftTargets",
    "build_loss",
    "cosine_distance",
    "softened_kl",
]
