"""What each way of doing less work for the same answers is worth in a training step of MambaLoc."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from mambaloc.benchmark.latency import in_turns
from mambaloc.benchmark.reference import Published
from mambaloc.benchmark.speed import Setting, ratio
from mambaloc.errors import InputError
from mambaloc.models.transposenet import LitTransPoseNet
from mambaloc.nn import GlobalInformationSelector

SAVINGS = {
    "dead_stages": "backbone cut after the last map that is read",
    "attention_dropout": "fused attention, whose own dropout is off",
    "every_token": "last encoder layer for the token alone",
    "scan": "GIS in its closed form",
    "torch_dropout": "a draw for four elements of a dropout's mask",
    "contiguous": "channels last",
}
"""By the argument of :class:`~mambaloc.benchmark.reference.Published` that leaves it out."""


@dataclass(frozen=True)
class Savings:
    """Seconds of forward and backward passes, an entry a repetition, all in turns.

    Args:
        ours: of our network, eager, fed with images that are normalised.
        left_out: of our network with one saving left out, by its name in :data:`SAVINGS`.
        published: with all of them left out.
        gis: of both branches' GIS; None where the system has none.
        gis_together: of both as one block, their weights stacked.
    """

    ours: list[float]
    left_out: dict[str, list[float]]
    published: list[float]
    gis: list[float] | None = None
    gis_together: list[float] | None = None

    def times_as_long(self, seconds: list[float]) -> tuple[float, float]:
        """Ratio to our network's, and the interquartile range."""
        return ratio(seconds, self.ours)


def measure_savings(setting: Setting, batch: int, repetitions: int = 5) -> Savings:
    """Time our network beside itself with each saving left out, with none, and its GIS alone in two forms.

    Raises:
        InputError: for a system that is neither MambaLoc nor TransPoseNet.
    """
    system, data = setting.build()
    if not isinstance(system, LitTransPoseNet):
        raise InputError(f"{setting.system}: has no published form here; choose mambaloc or transposenet")
    device = setting.device
    image = torch.rand(batch, 3, *data.crop, device=device)
    none: dict[str, bool] = dict.fromkeys(SAVINGS, False)
    forms = [none, *({**none, name: True} for name in SAVINGS), dict.fromkeys(SAVINGS, True)]
    calls = [_pass(Published(system, **form).to(device).train(), (image,), device, setting.is_half) for form in forms]
    blocks: list[Any] = [system.network.position_gis, system.network.orientation_gis]
    if isinstance(blocks[0], GlobalInformationSelector):
        feats = [torch.rand(batch, system.hparams["dim"], device=device, requires_grad=True) for _ in blocks]
        inputs = (*(block.to(device).train() for block in blocks), *feats)
        calls += [_pass(form, inputs, device, setting.is_half) for form in (_apart, gis_together)]
    with torch.random.fork_rng():
        ours, *rest = in_turns(calls, repetitions, device.type)
    left_out = dict(zip(SAVINGS, rest, strict=False))
    return Savings(ours, left_out, *rest[len(SAVINGS) :])


def _apart(first: nn.Module, second: nn.Module, first_BD: Tensor, second_BD: Tensor) -> tuple[Tensor, Tensor]:
    return first(first_BD), second(second_BD)


def gis_together(
    first: GlobalInformationSelector, second: GlobalInformationSelector, first_BD: Tensor, second_BD: Tensor
) -> tuple[Tensor, Tensor]:
    """Run two equal blocks as one: half of the kernel launches, for a copy of both blocks' weights.

    No system does so. On a CPU the copy takes longer than what it saves, and ``torch.compile`` launches still less.

    Shape:
        (B, D), (B, D) -> (B, D), (B, D).
    """
    pairs = zip(first.named_parameters(), second.parameters(), strict=True)
    stacked = {name: torch.stack((one, other)) for (name, one), other in pairs}
    both = torch.vmap(lambda weights, feats_BD: functional_call(first, weights, (feats_BD,)))
    first_BD, second_BD = both(stacked, torch.stack((first_BD, second_BD)))
    return first_BD, second_BD


def _pass(
    network: Callable[..., object], inputs: tuple[object, ...], device: torch.device, half: bool
) -> Callable[[], None]:
    """A forward and a backward pass."""

    def call() -> None:
        with torch.autocast(device.type, torch.bfloat16, enabled=half):
            said = network(*inputs)
        first, second = said if isinstance(said, tuple) else (said.position_m, said.quaternion)  # type: ignore[attr-defined]
        (first.sum() + second.sum()).backward()

    return call
