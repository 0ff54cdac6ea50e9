"""Attention with dropout against the same computed whole, with the masks that it draws."""

import pytest
import torch
import torch.nn.functional as F

from mambaloc.nn import attention
from mambaloc.nn.attention import attend
from mambaloc.nn.dropout import CHANCES

SHARE = 0.25


def tensors(dtype=torch.float64):
    torch.manual_seed(0)
    return [torch.randn(2, 3, count, 4, dtype=dtype, requires_grad=True) for count in (5, 7, 7)]


@pytest.fixture(params=[2**20, 8 * 7 * 2], ids=["a head at a time", "two rows at a time"])
def _blocks(request, monkeypatch):
    monkeypatch.setattr(attention, "_BLOCK_BYTES", request.param)


def masks(query, key, seed):
    """The masks, read off attention itself: with one-hot values its output is its dropped weights."""
    torch.manual_seed(seed)
    eye = torch.eye(key.shape[2], dtype=query.dtype).expand(*key.shape[:2], -1, -1)
    return attend(query, key, eye, SHARE) != 0


@pytest.mark.usefixtures("_blocks")
def test_values_and_gradients_are_those_of_whole_attention():
    query, key, value = tensors()
    kept = masks(query, key, seed=3)
    torch.manual_seed(3)
    ours = attend(query, key, value, SHARE)
    whole = ((query @ key.mT / 2).softmax(-1) * kept / (1 - SHARE)) @ value
    torch.testing.assert_close(ours, whole)
    grad = torch.randn_like(whole)
    found, expected = (torch.autograd.grad(result, (query, key, value), grad) for result in (ours, whole))
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs)


def test_it_drops_its_share_of_each_heads_weights():
    torch.manual_seed(0)
    query, key = torch.randn(2, 2, 400, 8), torch.randn(2, 2, 300, 8)
    kept = masks(query, key, seed=1).float()
    assert kept.mean((2, 3)).sub(1 - SHARE).abs().max() < 0.01
    flat = kept.flatten(0, 1).flatten(1)
    assert (torch.corrcoef(flat) - torch.eye(4)).abs().max() < 0.02
    assert round(SHARE * CHANCES) / CHANCES == SHARE


def test_a_seed_decides():
    query, key, value = tensors()
    outs = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        outs.append(attend(query, key, value, SHARE))
    assert torch.equal(outs[0], outs[1])
    assert not torch.equal(outs[0], outs[2])


def test_without_dropout_it_is_pytorchs():
    query, key, value = tensors()
    assert torch.equal(attend(query, key, value), F.scaled_dot_product_attention(query, key, value))
