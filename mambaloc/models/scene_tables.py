"""Those weights of a network that have as many rows for each of several scenes: copied and trained by the scene."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from mambaloc.nn import PoseNetwork


def rows_of_scenes(
    network: PoseNetwork, state: dict[str, Tensor], known: Sequence[str], scenes: Sequence[str]
) -> dict[str, Tensor]:
    """What a network is to have in its tables to know what another one does: of new scenes, its own rows.

    Args:
        network: of ``scenes``.
        state: of a like network.
        known: names of the scenes of that one.
        scenes: names of those of ``network``.
    """
    rows = {}
    for name, own in network.state_dict().items():
        if not name.startswith(network.scene_tables):
            continue
        table = own.clone().reshape(len(scenes), -1)
        if name in state:  # that of one scene recognises none
            other = state[name].reshape(len(known), -1)
            for index, scene in enumerate(scenes):
                if scene in known:
                    table[index] = other[known.index(scene)]
        rows[name] = table.view_as(own)
    return rows


def train_rows_only(network: PoseNetwork, scenes: Sequence[int]) -> None:
    """Freeze a network but for the rows of some scenes; an optimizer must not decay the others.

    Args:
        network: of several scenes.
        scenes: numbers of those whose rows get gradients.
    """
    network.requires_grad_(False)
    network.backbone.freeze_statistics()
    is_trained = torch.zeros(network.scenes, 1)
    is_trained[list(scenes)] = 1
    for name, parameter in network.named_parameters():
        if name.startswith(network.scene_tables):
            parameter.requires_grad_(True).register_hook(partial(_of_rows, is_trained))


def _of_rows(is_trained: Tensor, grad: Tensor) -> Tensor:
    """A gradient (S * k, ...) of the rows that are trained alone; (S, 1) of ones and zeros."""
    return (grad.reshape(len(is_trained), -1) * is_trained.to(grad)).view_as(grad)
