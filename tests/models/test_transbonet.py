import pytest
import torch
from torch.testing import assert_close

import mambaloc
from mambaloc.models.transbonet import ShuffleAttention


@torch.no_grad()
def test_shuffle_attention_group_by_group():
    torch.manual_seed(0)
    channels, groups = 16, 2
    attention, feats = ShuffleAttention(channels, groups), torch.randn(3, channels, 4, 5)
    for parameter in attention.parameters():
        parameter.normal_()
    weighed = []
    for group in feats.split(channels // groups, dim=1):
        by_channel, by_place = group[:, :4], group[:, 4:]
        mean = by_channel.mean((2, 3), keepdim=True)
        weighed.append(by_channel * torch.sigmoid(attention.channel_scale * mean + attention.channel_shift))
        normed = torch.nn.functional.instance_norm(by_place)
        weighed.append(by_place * torch.sigmoid(attention.spatial_scale * normed + attention.spatial_shift))
    stacked = torch.cat(weighed, dim=1)
    shuffled = stacked[:, [i for j in range(8) for i in (j, j + 8)]]  # one from each half in turn
    assert_close(attention(feats), shuffled, rtol=1e-5, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("size", [64, (64, 96), (80, 112)])  # feature maps even, wide, and odd
def test_image_sizes(size):
    small = {"backbone": "resnet10t", "stage_channels": 64, "blocks": 2, "groups": 4, "width": 32, "head_hidden": 16}
    system = mambaloc.create_model("transbonet", image_size=size, **small).eval()
    assert system(torch.rand(2, 3, *system.image_size)).quaternion.shape == (2, 4)
