import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from mambaloc.nn import TokenEncoder
from mambaloc.nn.encoder import EncoderLayer, LearnedPositions

DIM, HEADS, HIDDEN = 24, 4, 40


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def randomize(module: nn.Module) -> nn.Module:
    """Move norms and biases off their trivial initial values."""
    torch.manual_seed(1)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(torch.randn_like(parameter), alpha=0.2)
    return module.eval()


def layer(dropout: float = 0.1, attention_dropout: float = 0.0) -> EncoderLayer:
    torch.manual_seed(0)
    return randomize(EncoderLayer(DIM, HEADS, HIDDEN, dropout, attention_dropout))


def encoder(grid: tuple[int, int] = (2, 3), layers: int = 2, dropout: float = 0.1) -> TokenEncoder:
    torch.manual_seed(0)
    return randomize(TokenEncoder(5, grid, DIM, layers, HEADS, HIDDEN, dropout))


# --- a layer ---------------------------------------------------------------------------------------------------------


def second_implementation(ours: EncoderLayer, tokens: Tensor, positions: Tensor) -> Tensor:
    """The same layer out of PyTorch's own attention, weights copied over."""
    attention = nn.MultiheadAttention(DIM, HEADS, batch_first=True).eval()
    with torch.no_grad():
        attention.in_proj_weight.copy_(torch.cat((ours.qk.weight, ours.v.weight)))
        attention.in_proj_bias.copy_(torch.cat((ours.qk.bias, ours.v.bias)))
        attention.out_proj.load_state_dict(ours.out.state_dict())
    norms = [nn.LayerNorm(DIM), nn.LayerNorm(DIM)]
    for norm, mine in zip(norms, (ours.norm_attention, ours.norm_mlp), strict=True):
        norm.load_state_dict(mine.state_dict())
    normed = norms[0](tokens)
    tokens = tokens + attention(normed + positions, normed + positions, normed, need_weights=False)[0]
    first, second = ours.mlp[0], ours.mlp[3]
    hidden = nn.functional.gelu(norms[1](tokens) @ first.weight.T + first.bias)
    return tokens + hidden @ second.weight.T + second.bias


@torch.no_grad()
def test_layer_is_pre_norm_multihead_attention():
    tokens, positions = random(3, 7, DIM), random(7, DIM, seed=1)
    ours = layer()
    assert_close(ours(tokens, positions), second_implementation(ours, tokens, positions), rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_positions_reach_queries_and_keys_but_not_values():
    tokens, positions, others = random(3, 7, DIM), random(7, DIM, seed=1), random(7, DIM, seed=2)
    ours = layer()
    assert (ours(tokens, positions) - ours(tokens, others)).abs().max() > 1e-3
    ours.qk.weight.zero_()  # attention is uniform now: what is left comes from the values
    assert_close(ours(tokens, positions), ours(tokens, others), rtol=0, atol=0)


@torch.no_grad()
@pytest.mark.parametrize("kwargs", [{"dropout": 0.5}, {"dropout": 0.0, "attention_dropout": 0.5}], ids=str)
def test_dropout_acts_in_training_only(kwargs):
    tokens, positions = random(3, 7, DIM), random(7, DIM, seed=1)
    ours = layer(**kwargs)
    assert torch.equal(ours(tokens, positions), ours(tokens, positions))
    ours.train()
    assert not torch.equal(ours(tokens, positions), ours(tokens, positions))


@torch.no_grad()
def test_without_any_dropout_training_is_evaluation():
    tokens, positions = random(3, 7, DIM), random(7, DIM, seed=1)
    ours = layer(dropout=0.0)
    assert_close(ours.train()(tokens, positions), ours.eval()(tokens, positions), rtol=1e-5, atol=1e-6)


# --- positions -------------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_positions_lay_columns_then_rows_over_the_grid():
    positions = LearnedPositions((2, 3), 2)
    positions.row.copy_(torch.tensor([[10.0], [11.0], [12.0]]))  # the first is the token's
    positions.column.copy_(torch.tensor([[20.0], [21.0], [22.0], [23.0]]))
    expected = torch.tensor(
        [
            [20.0, 10.0],  # token
            [21.0, 11.0], [22.0, 11.0], [23.0, 11.0],  # first row
            [21.0, 12.0], [22.0, 12.0], [23.0, 12.0],
        ]
    )  # fmt: skip
    assert torch.equal(positions(), expected)


def test_tables_have_a_row_and_a_column_of_the_token():
    positions = LearnedPositions((14, 9), 256)
    assert (positions.row.shape, positions.column.shape) == ((15, 128), (10, 128))
    assert positions().shape == (1 + 14 * 9, 256)


# --- the encoder -----------------------------------------------------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize(("table", "axis", "order"), [("row", 2, [2, 0, 1]), ("column", 3, [3, 1, 0, 2])])
def test_cells_may_be_permuted_with_their_positions_but_not_alone(table, axis, order):
    ours, feats = encoder(grid=(3, 4)), random(2, 5, 3, 4)
    before = ours(feats)
    shuffled = feats.index_select(axis, torch.tensor(order))
    assert (ours(shuffled) - before).abs().max() > 1e-3
    positions = getattr(ours.positions, table)
    positions[1:] = positions[1:][order].clone()
    assert_close(ours(shuffled), before, rtol=1e-5, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("layers", [1, 3])
def test_encoder_reads_the_token_through_all_layers_and_the_final_norm(layers):
    ours, feats = encoder(layers=layers), random(2, 5, 2, 3)
    cells = torch.einsum("bchw,dc->bhwd", feats, ours.project.weight[:, :, 0, 0]) + ours.project.bias
    tokens = torch.cat((ours.token.expand(2, 1, DIM), cells.reshape(2, 6, DIM)), dim=1)
    for each in ours.layers:
        tokens = second_implementation(each, tokens, ours.positions())
    token = tokens[:, 0]
    centered = token - token.mean(-1, keepdim=True)
    normed = centered / (centered.square().mean(-1, keepdim=True) + ours.norm.eps).sqrt()
    assert_close(ours(feats), normed * ours.norm.weight + ours.norm.bias, rtol=1e-4, atol=1e-4)
    assert len(ours.layers) == layers


def test_every_encoder_parameter_is_trained():
    ours = encoder().train()
    (ours(random(2, 5, 2, 3)) * random(2, DIM, seed=1)).sum().backward()
    assert {n for n, p in ours.named_parameters() if p.grad is None or not p.grad.any()} == set()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: EncoderLayer(25, 4, 8, 0.1, 0.0), "multiple of 4 heads"),
        (lambda: LearnedPositions((2, 2), 5), "even"),
    ],
)
def test_widths_that_do_not_divide_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
