"""A backbone in two parts gives what the whole gives, whichever groups are frozen."""

import pytest
import torch
from timm.models import group_parameters
from torch.testing import assert_close

from mambaloc.errors import InputError
from mambaloc.nn import Backbone, PooledBackbone, SplitBackbone

NAMES = ("resnet10t", "mobilenetv2_050", "mobilenetv3_small_050", "efficientnet_b0", "seresnet50", "convnext_atto")
SIZE = (32, 48)


def image():
    return torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(1))


def groups_of(backbone):
    return len(group_parameters(backbone.model, backbone.model.group_matcher(coarse=True)))


@pytest.mark.parametrize("kind", [Backbone, PooledBackbone])
@pytest.mark.parametrize("name", NAMES)
def test_two_parts_give_what_the_whole_gives(name, kind):
    torch.manual_seed(0)
    for groups in range(1, groups_of(kind(name)) + 1):
        backbone = kind(name).eval()
        backbone.freeze(groups)
        split = SplitBackbone(backbone, SIZE)
        assert_close(split.trained(split.frozen(image())), backbone(image()), rtol=1e-4, atol=1e-5)


def test_the_trained_part_has_the_gradients_of_the_whole():
    torch.manual_seed(0)
    backbone = Backbone("mobilenetv2_050", strides=(8, 16))
    backbone.freeze(4)
    backbone.freeze_statistics()
    split, found = SplitBackbone(backbone.train(), SIZE), []
    kept = split.frozen(image())
    assert [tuple(each.shape[1:]) for each in kept] == [(16, 4, 6)]  # the map at stride 8 is where the rest begins
    for maps in (split.trained(kept), backbone(image())):
        backbone.zero_grad()
        sum(each.square().mean() for each in maps).backward()
        found.append({name: p.grad.clone() for name, p in backbone.named_parameters() if p.grad is not None})
    assert found[0]
    assert_close(found[0], found[1], rtol=1e-4, atol=1e-6)


def test_an_earlier_map_is_kept_beside_the_one_that_goes_on():
    backbone = Backbone("mobilenetv2_050", strides=(8, 16, 32)).eval()
    backbone.freeze(6)  # up to stride 16
    kept = SplitBackbone(backbone, SIZE).frozen(image())
    assert [each.shape[-2:] for each in kept] == [(4, 6), (2, 3)]


def test_a_backbone_of_which_nothing_is_frozen():
    with pytest.raises(InputError, match=r"model\.frozen_groups 0: resnet10t has no frozen features to keep"):
        SplitBackbone(Backbone("resnet10t"), SIZE)
