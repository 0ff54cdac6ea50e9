"""Transformer encoder over a feature map, read out at one learned token (TransPoseNet, Shavit et al. 2024)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mambaloc.nn.attention import attend
from mambaloc.nn.dropout import Dropout


class LearnedPositions(nn.Module):
    """Learned row and column encodings of a grid, with a row and a column of their own for the token.

    Args:
        grid: rows and columns of the feature map.
        dim: token width; each half encodes one axis.

    Shape:
        () -> (1 + rows * columns, dim), the token first.
    """

    def __init__(self, grid: tuple[int, int], dim: int) -> None:
        super().__init__()
        if dim % 2:
            raise ValueError(f"dim must be even to hold a row and a column half, not {dim}")
        self.row = nn.Parameter(torch.rand(grid[0] + 1, dim // 2))  # uniform, as in DETR's learned encoding
        self.column = nn.Parameter(torch.rand(grid[1] + 1, dim // 2))

    def forward(self) -> Tensor:
        """Lay the tables out over the tokens."""
        rows, columns = self.row.shape[0] - 1, self.column.shape[0] - 1
        cells_HWC = torch.cat(
            (
                self.column[1:].unsqueeze(0).expand(rows, -1, -1),
                self.row[1:].unsqueeze(1).expand(-1, columns, -1),
            ),
            dim=-1,
        )
        token_1C = torch.cat((self.column[:1], self.row[:1]), dim=-1)
        return torch.cat((token_1C, cells_HWC.flatten(0, 1)))


class EncoderLayer(nn.Module):
    """Pre-norm encoder layer whose queries and keys, not values, carry the position encoding (as in DETR).

    Args:
        dim: token width.
        heads: attention heads.
        feedforward: hidden width of the two-layer MLP with GELU.
        dropout: after attention, inside and after the MLP.
        attention_dropout: on attention weights. A training step on a CPU then takes 1.2 times as long, and on a GPU
            PyTorch chooses another kernel, so it is off unless asked for.

    Shape:
        tokens (B, N, D), positions (N, D) -> (B, N, D).
    """

    def __init__(self, dim: int, heads: int, feedforward: int, dropout: float, attention_dropout: float) -> None:
        super().__init__()
        if dim % heads:
            raise ValueError(f"width {dim} is not a multiple of {heads} heads")
        self.heads, self.attention_dropout = heads, attention_dropout
        self.norm_attention = nn.LayerNorm(dim)
        self.qk = nn.Linear(dim, 2 * dim)
        self.v = nn.Linear(dim, dim)
        self.out = nn.Linear(dim, dim)
        self.norm_mlp = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, feedforward), nn.GELU(), Dropout(dropout), nn.Linear(feedforward, dim))
        self.dropout = Dropout(dropout)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)

    def forward(self, tokens_BND: Tensor, positions_ND: Tensor, keep: int | None = None) -> Tensor:
        """Attend, then transform each token; both around a residual.

        With ``keep`` only so many first tokens are computed, (B, keep, D): all attend, and are attended to, as before.
        """
        attended_BND = self._attend(self.norm_attention(tokens_BND), positions_ND, keep)
        tokens_BND = tokens_BND[:, :keep] + self.dropout(attended_BND)
        return tokens_BND + self.dropout(self.mlp(self.norm_mlp(tokens_BND)))

    def _attend(self, tokens_BND: Tensor, positions_ND: Tensor, keep: int | None) -> Tensor:
        placed_BND = tokens_BND + positions_ND
        (query_weight, key_weight), (query_bias, key_bias) = self.qk.weight.chunk(2), self.qk.bias.chunk(2)
        query_BND = F.linear(placed_BND[:, :keep], query_weight, query_bias)
        key_BND = F.linear(placed_BND, key_weight, key_bias)
        q, k, v = (t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in (query_BND, key_BND, self.v(tokens_BND)))
        dropout = self.attention_dropout if self.training else 0.0
        return self.out(attend(q, k, v, dropout).transpose(1, 2).flatten(2))


class TokenEncoder(nn.Module):
    """Summarise a feature map in one learned token: 1x1 convolution, positions, encoder layers, final norm.

    Args:
        in_channels: depth of the feature map.
        grid: its rows and columns, which fix the size of the position tables.
        dim: token width.
        layers: encoder layers.
        heads: attention heads.
        feedforward: hidden width of each layer's MLP.
        dropout: residual and MLP dropout.
        attention_dropout: see :class:`EncoderLayer`.

    Shape:
        (B, C, rows, columns) -> (B, dim).
    """

    def __init__(
        self,
        in_channels: int,
        grid: tuple[int, int],
        dim: int = 256,
        layers: int = 6,
        heads: int = 8,
        feedforward: int = 256,
        dropout: float = 0.1,
        attention_dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.project = nn.Conv2d(in_channels, dim, 1)
        self.token = nn.Parameter(torch.zeros(1, 1, dim))
        self.positions = LearnedPositions(grid, dim)
        self.layers = nn.ModuleList(
            EncoderLayer(dim, heads, feedforward, dropout, attention_dropout) for _ in range(layers)
        )
        self.norm = nn.LayerNorm(dim)

    def forward(self, feats_BCHW: Tensor) -> Tensor:
        """Return the token's final state."""
        tokens_BND, positions_ND = self._before_the_last_layer(feats_BCHW)
        return self.norm(self.layers[-1](tokens_BND, positions_ND, keep=1)[:, 0])  # only the token is read

    def cells(self, feats_BCHW: Tensor) -> Tensor:
        """Return every cell's final state, which :meth:`forward` leaves out; (B, dim, rows, columns)."""
        tokens_BND, positions_ND = self._before_the_last_layer(feats_BCHW)
        cells_BND = self.norm(self.layers[-1](tokens_BND, positions_ND)[:, 1:])
        return cells_BND.mT.unflatten(-1, feats_BCHW.shape[-2:])

    def _before_the_last_layer(self, feats_BCHW: Tensor) -> tuple[Tensor, Tensor]:
        """The token and the cells after all layers but the last, (B, N, dim), and their positions, (N, dim)."""
        cells_BND = self.project(feats_BCHW).flatten(2).mT
        tokens_BND = torch.cat((self.token.expand(cells_BND.shape[0], -1, -1), cells_BND), dim=1)
        positions_ND = self.positions()
        *layers, _ = self.layers
        for layer in layers:
            tokens_BND = layer(tokens_BND, positions_ND)
        return tokens_BND, positions_ND
