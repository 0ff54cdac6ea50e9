"""Selective state-space mixer (Mamba, Gu and Dao 2023, arXiv:2312.00752): a scan of any length, and closed forms.

Parameter names and shapes are those of the reference Mamba-1 mixer, so weights are interchangeable with it.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Discretization = Literal["euler", "zoh"]


def discretized_input(
    dt_BLE: Tensor, A_ES: Tensor, B_BLS: Tensor, x_BLE: Tensor, discretisation: Discretization
) -> Tensor:
    """Return ``B_bar * x``, what each step adds to the state, (B, L, E, S).

    ``euler`` is the reference Mamba's ``dt * B``; ``zoh`` the exact zero-order hold ``A^-1 (exp(dt A) - 1) B``
    of the MambaLoc paper (its equation for B_bar).
    """
    gain_BLES = torch.expm1(dt_BLE.unsqueeze(-1) * A_ES) / A_ES if discretisation == "zoh" else dt_BLE.unsqueeze(-1)
    return gain_BLES * B_BLS.unsqueeze(2) * x_BLE.unsqueeze(-1)


def selective_scan(
    x_BLE: Tensor,
    dt_BLE: Tensor,
    A_ES: Tensor,
    B_BLS: Tensor,
    C_BLS: Tensor,
    D_E: Tensor,
    discretisation: Discretization = "euler",
) -> Tensor:
    """Run ``h_t = exp(dt_t A) h_(t-1) + B_bar_t x_t``, ``y_t = C_t . h_t + D x_t`` over any length; (B, L, E).

    The tested reference for every faster form. The loop runs over ``unbind``: indexing ``[:, t]`` in it
    would make the backward pass quadratic in L.
    """
    decay_BLES = torch.exp(dt_BLE.unsqueeze(-1) * A_ES)
    update_BLES = discretized_input(dt_BLE, A_ES, B_BLS, x_BLE, discretisation)
    state_BES = torch.zeros_like(update_BLES[:, 0])
    outputs = []
    for decay, update, C_BS in zip(decay_BLES.unbind(1), update_BLES.unbind(1), C_BLS.unbind(1), strict=True):
        state_BES = decay * state_BES + update
        outputs.append((state_BES * C_BS.unsqueeze(1)).sum(-1))
    return torch.stack(outputs, dim=1) + D_E * x_BLE


class MambaMixer(nn.Module):
    """One Mamba-1 mixer: gated causal convolution and selective scan, without norm or residual.

    Args:
        d_model: input and output width D.
        d_state: state size S per channel.
        d_conv: taps of the causal depthwise convolution.
        expand: inner width E as a multiple of D.
        dt_rank: rank of the step-size projection; ``ceil(D / 16)`` unless given.
        discretisation: ``euler`` (reference Mamba) or ``zoh`` (as the MambaLoc paper writes).

    Shape:
        (B, L, D) -> (B, L, D).
    """

    def __init__(
        self,
        d_model: int,
        d_state: int = 16,
        d_conv: int = 4,
        expand: int = 1,
        dt_rank: int | None = None,
        discretisation: Discretization = "euler",
    ) -> None:
        super().__init__()
        if discretisation not in ("euler", "zoh"):
            raise ValueError(f"discretisation is 'euler' or 'zoh', not {discretisation!r}")
        if d_conv < 2:
            raise ValueError(f"d_conv is at least 2, not {d_conv}: the length-2 closed form reads the last two taps")
        d_inner = expand * d_model
        self.d_state, self.dt_rank, self.discretisation = d_state, dt_rank or math.ceil(d_model / 16), discretisation
        self.in_proj = nn.Linear(d_model, 2 * d_inner, bias=False)
        self.conv1d = nn.Conv1d(d_inner, d_inner, d_conv, groups=d_inner, padding=d_conv - 1)
        self.x_proj = nn.Linear(d_inner, self.dt_rank + 2 * d_state, bias=False)
        self.dt_proj = nn.Linear(self.dt_rank, d_inner)
        self.A_log = nn.Parameter(torch.arange(1, d_state + 1, dtype=torch.float32).log().repeat(d_inner, 1))
        self.D = nn.Parameter(torch.ones(d_inner))
        self.out_proj = nn.Linear(d_inner, d_model, bias=False)
        self._init_step_size()

    def no_weight_decay(self) -> set[str]:
        """Names of the parameters that an optimiser must not decay (reference Mamba)."""
        return {"A_log", "D"}

    @torch.no_grad()
    def _init_step_size(self, dt_min: float = 1e-3, dt_max: float = 1e-1) -> None:
        """Draw softplus(bias) log-uniformly in [dt_min, dt_max] (reference Mamba)."""
        nn.init.uniform_(self.dt_proj.weight, -(self.dt_rank**-0.5), self.dt_rank**-0.5)
        dt = torch.exp(torch.empty_like(self.dt_proj.bias).uniform_(math.log(dt_min), math.log(dt_max)))
        self.dt_proj.bias.copy_(dt + torch.log(-torch.expm1(-dt)))  # the inverse of softplus

    def forward(self, x_BLD: Tensor) -> Tensor:
        """Mix a sequence of any length with the general scan."""
        x_BLE, gate_BLE = self.in_proj(x_BLD).chunk(2, dim=-1)
        x_BLE = F.silu(self.conv1d(x_BLE.mT)[..., : x_BLD.shape[1]].mT)
        dt_BLE, B_BLS, C_BLS = self._select(x_BLE)
        y_BLE = selective_scan(x_BLE, dt_BLE, -self.A_log.exp(), B_BLS, C_BLS, self.D, self.discretisation)
        return self.out_proj(y_BLE * F.silu(gate_BLE))

    def last_of_two(self, first_BD: Tensor, last_BD: Tensor) -> Tensor:
        """Return ``forward([first, last])[:, 1]`` exactly, without a scan, (B, D).

        At length 2, with ``h_(-1) = 0``, the output of token 1 is

            y_1 = B_bar_0 x_0 . (C_1 exp(dt_1 A)) + B_bar_1 x_1 . C_1 + D x_1

        so token 0 needs neither C, gate nor output projection, and of the convolution's taps only the last two
        meet anything but padding. Both tokens share each product all the same: reading a weight is what costs.
        """
        u_B2E, gate_B2E = self.in_proj(torch.stack((first_BD, last_BD), dim=1)).chunk(2, dim=-1)
        assert self.conv1d.bias is not None
        previous_E, current_E = self.conv1d.weight[:, 0, -2], self.conv1d.weight[:, 0, -1]
        now_B2E = current_E * u_B2E + self.conv1d.bias
        x_B2E = F.silu(torch.stack((now_B2E[:, 0], now_B2E[:, 1] + previous_E * u_B2E[:, 0]), dim=1))
        dt_B2E, B_B2S, C_B2S = self._select(x_B2E)

        A_ES = -self.A_log.exp()
        update_B2ES = discretized_input(dt_B2E, A_ES, B_B2S, x_B2E, self.discretisation)
        state_BES = torch.exp(dt_B2E[:, 1].unsqueeze(-1) * A_ES) * update_B2ES[:, 0] + update_B2ES[:, 1]
        y_BE = (state_BES * C_B2S[:, 1].unsqueeze(1)).sum(-1) + self.D * x_B2E[:, 1]
        return self.out_proj(y_BE * F.silu(gate_B2E[:, 1]))

    def _select(self, x_BLE: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project the input to its own step size, input and output matrices: the selection mechanism."""
        dt_BLR, B_BLS, C_BLS = self.x_proj(x_BLE).split([self.dt_rank, self.d_state, self.d_state], dim=-1)
        return F.softplus(self.dt_proj(dt_BLR)), B_BLS, C_BLS
