"""Dropout by few draws: how much it drops, what it does to gradients, and when it does nothing."""

import pytest
import torch
from torch import nn

from mambaloc.nn.dropout import Dropout


@pytest.mark.parametrize("p", [0.05, 0.1, 0.5, 0.9])
def test_it_drops_its_share_and_keeps_the_mean(p):
    torch.manual_seed(0)
    out = Dropout(p)(torch.ones(1000, 1001))
    kept = out != 0
    assert kept.float().mean().item() == pytest.approx(1 - p, abs=0.002)
    assert out[kept].unique().tolist() == pytest.approx([1 / (1 - p)], rel=2e-4)
    assert out.mean().item() == pytest.approx(1, abs=0.01)


def test_elements_are_dropped_each_for_itself():
    """Four chances come from one draw: neighbours must not share their fate."""
    torch.manual_seed(0)
    dropped = (Dropout(0.5)(torch.ones(400_000)) == 0).float().view(-1, 4)
    assert (torch.corrcoef(dropped.T) - torch.eye(4)).abs().max() < 0.02
    assert dropped.mean(0).sub(0.5).abs().max() < 0.01


def test_gradients_pass_where_values_do():
    torch.manual_seed(0)
    feats = torch.rand(7, 5, requires_grad=True)
    out = Dropout(0.4)(feats)
    out.sum().backward()
    torch.testing.assert_close(feats.grad, (out / feats).detach())


def test_a_seed_decides():
    feats = torch.rand(3, 7, 5)
    outs = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        outs.append(Dropout(0.3)(feats))
    assert torch.equal(outs[0], outs[1])
    assert not torch.equal(outs[0], outs[2])


@pytest.mark.parametrize("p", [0.0, 0.1, 1.0])
def test_outside_training_and_at_the_ends_it_is_pytorchs(p):
    feats = torch.rand(3, 5)
    assert torch.equal(Dropout(p).eval()(feats), feats)
    if p in (0.0, 1.0):
        assert torch.equal(Dropout(p)(feats), nn.Dropout(p)(feats))


def test_it_works_on_an_empty_batch_and_in_bfloat16():
    assert Dropout(0.1)(torch.ones(0, 5)).shape == (0, 5)
    assert Dropout(0.1)(torch.ones(4, 5, dtype=torch.bfloat16)).dtype == torch.bfloat16


def test_compiling_takes_it_whole():
    torch.manual_seed(0)
    compiled = torch.compile(Dropout(0.5), fullgraph=True, backend="eager")
    assert (compiled(torch.ones(100, 100)) == 0).float().mean().item() == pytest.approx(0.5, abs=0.05)
