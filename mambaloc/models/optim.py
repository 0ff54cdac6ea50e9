"""Adam, and the schedules of its learning rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import lightning as L
import torch
from torch import nn
from torch.optim import lr_scheduler

from mambaloc.errors import InputError

Schedule = Literal["step", "cosine", "one_cycle"]


def build_adam(module: nn.Module, lr: float, beta2: float, weight_decay: float, fused: bool) -> torch.optim.Adam:
    """Adam over the trainable parameters; those that a submodule names in ``no_weight_decay()`` are not decayed.

    Args:
        module: what is trained.
        lr: learning rate.
        beta2: decay of the running mean of squared gradients.
        weight_decay: L2 penalty.
        fused: read and write each parameter once a step, which saves a tenth of the time on a CPU.
    """
    undecayed = {
        id(parameter)
        for submodule in module.modules()
        if hasattr(submodule, "no_weight_decay")
        for name, parameter in submodule.named_parameters()
        if name in submodule.no_weight_decay()  # type: ignore[operator]  # timm's are dotted, and may name what a model lacks
    }
    trainable = [p for p in module.parameters() if p.requires_grad]
    groups = [
        {"params": [p for p in trainable if id(p) not in undecayed], "weight_decay": weight_decay},
        {"params": [p for p in trainable if id(p) in undecayed], "weight_decay": 0.0},
    ]
    groups = [group for group in groups if group["params"]]
    return torch.optim.Adam(groups, lr=lr, betas=(0.9, beta2), eps=1e-10, fused=fused)


def build_step_schedule(
    optimizer: torch.optim.Optimizer, schedule: Schedule, lr: float, steps: int
) -> lr_scheduler.LRScheduler:
    """A schedule, ``cosine`` or ``one_cycle``, that spans the steps of a whole training."""
    if schedule == "cosine":
        return lr_scheduler.CosineAnnealingLR(optimizer, steps)
    return lr_scheduler.OneCycleLR(optimizer, lr, steps, cycle_momentum=False)


def training_steps(trainer: L.Trainer, batches: int, schedule: Schedule) -> int:
    """Steps of a whole training, which a schedule spans.

    Lightning's own estimate starts the loaders, before a resumed run has set their epoch.

    Args:
        trainer: set up to fit.
        batches: of an epoch, before the trainer's limits.
        schedule: whose length they are.

    Raises:
        InputError: where the trainer has no last step.
    """
    limit = trainer.limit_train_batches
    batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
    ends = [] if trainer.max_steps == -1 else [trainer.max_steps]
    if trainer.max_epochs not in (None, -1):
        ends.append(trainer.max_epochs * math.ceil(batches / trainer.accumulate_grad_batches))
    if not ends:
        raise InputError(f"model.schedule {schedule}: needs the training's length; set trainer.max_epochs")
    return min(ends)


def check_span(states: Sequence[dict[str, Any]], steps: int) -> None:
    """Refuse to resume a training whose schedules span another number of steps.

    Args:
        states: of the schedules in the checkpoint.
        steps: of the training that goes on.

    Raises:
        InputError: where they differ.
    """
    for state in states:
        if (span := state.get("total_steps", state.get("T_max"))) != steps:
            raise InputError(
                f"--ckpt_path: its schedule has {span} steps, but this training has {steps}; keep its length, or "
                "start from its weights with model.warm_start"
            )
