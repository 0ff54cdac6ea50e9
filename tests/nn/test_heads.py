import pytest
import torch

from mambaloc.nn import PositionScale, RegressionHead


def test_head_regresses_in_float32_under_autocast():
    head, feats = RegressionHead(8, 16, 3), torch.randn(2, 8)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.nn.Linear(8, 3)(feats).dtype == torch.bfloat16
        regressed = head(feats)
    assert regressed.dtype == torch.float32
    assert torch.equal(regressed, head(feats))


def test_position_scale_undoes_the_normalization_it_was_fitted_to():
    position_m = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * 3 + torch.tensor([10.0, -5.0, 2.0])
    scale = PositionScale()
    assert torch.equal(scale(position_m), position_m)
    scale.fit(position_m)
    normalized = (position_m - position_m.mean(0)) / scale.scale_m
    assert normalized.norm(dim=1).square().mean().item() == pytest.approx(1, rel=1e-5)
    torch.testing.assert_close(scale(normalized), position_m)


def test_position_scale_of_one_place_is_finite():
    scale = PositionScale()
    scale.fit(torch.ones(4, 3))
    assert scale.scale_m > 0
