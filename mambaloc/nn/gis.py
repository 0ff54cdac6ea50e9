"""Global Information Selector (GIS; MambaLoc, section III-C and algorithm 1), and its ablations."""

from __future__ import annotations

from typing import Literal

from torch import Tensor, nn

from mambaloc.nn.ssm import Discretization, MambaMixer

GISMode = Literal["none", "classical", "gis"]


class GlobalInformationSelector(nn.Module):
    """Compress a global feature with one Mamba mixer that has first seen it flipped.

    The feature ``g`` becomes the sequence ``[flip(g), g]``; the output is that of the second token, which has
    causally seen both. There is no residual and no norm.

    Args:
        dim: feature width D.
        mode: ``gis``, or ``classical`` for the ablation's mixer over the length-1 sequence ``[g]``.
        d_state: state size per channel, 16 in the paper.
        discretisation: ``euler`` (reference Mamba) or ``zoh`` (as the paper writes).

    Shape:
        (B, D) -> (B, D).
    """

    def __init__(
        self,
        dim: int,
        mode: Literal["classical", "gis"] = "gis",
        d_state: int = 16,
        discretisation: Discretization = "euler",
    ) -> None:
        super().__init__()
        if mode not in ("classical", "gis"):
            raise ValueError(f"mode is 'classical' or 'gis', not {mode!r}")
        self.mode = mode
        self.mixer = MambaMixer(dim, d_state=d_state, discretisation=discretisation)

    def forward(self, feats_BD: Tensor) -> Tensor:
        """Select from one feature vector per image."""
        if self.mode == "classical":
            return self.mixer(feats_BD.unsqueeze(1)).squeeze(1)
        return self.mixer.last_of_two(feats_BD.flip(-1), feats_BD)


def build_gis(mode: GISMode, dim: int, discretisation: Discretization = "euler") -> nn.Module:
    """Build a host's block for its ``gis=`` option: the identity for ``none``."""
    if mode == "none":
        return nn.Identity()
    return GlobalInformationSelector(dim, mode, discretisation=discretisation)
