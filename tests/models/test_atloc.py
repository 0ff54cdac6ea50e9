import numpy as np
import torch
from torch.testing import assert_close

from mambaloc.models.atloc import FeatureAttention


@torch.no_grad()
def test_attention_by_hand():
    """A feature of two entries and projections of two, all in small whole numbers."""
    attention = FeatureAttention(dim=2, inner=2)
    for layer, weight in ((attention.g, [[1.0, 0], [0, 2]]), (attention.theta, [[0.0, 1], [0, 0]]),
                          (attention.phi, [[1.0, 0], [0, 0]]), (attention.out, [[1.0, 0], [1, 1]])):  # fmt: skip
        layer.weight.copy_(torch.tensor(weight))
        layer.bias.zero_()
    # x = (1, 3): g = (1, 6), theta = (3, 0), phi = (1, 0). Affinity phi theta^T = [[3, 0], [0, 0]].
    share = np.exp(3) / (np.exp(3) + 1)
    first, second = share * 1 + (1 - share) * 6, 0.5 * 1 + 0.5 * 6
    expected = torch.tensor([[1 + first, 3 + first + second]])
    assert_close(attention(torch.tensor([[1.0, 3.0]])), expected.float())


@torch.no_grad()
def test_attention_is_the_published_chain_of_products():
    torch.manual_seed(0)
    attention, feats = FeatureAttention(dim=16, inner=4), torch.randn(3, 16)
    for feat, attended in zip(feats, attention(feats), strict=True):
        g, theta, phi = (layer(feat[None]).T for layer in (attention.g, attention.theta, attention.phi))
        weights = torch.softmax(phi @ theta.T, dim=1)
        assert_close(attended, feat + attention.out((weights @ g).T)[0])
