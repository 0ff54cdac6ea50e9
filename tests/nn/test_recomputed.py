"""Stages that are computed again: the same values, gradients and statistics as when they are kept, and less kept."""

from copy import deepcopy

import pytest
import torch

from mambaloc.errors import InputError
from mambaloc.models import create_model
from mambaloc.nn import Backbone, PooledBackbone, recompute_stages
from mambaloc.nn.recomputed import RecomputedSequential


def step(backbone, image):
    """Gradients, buffers after a step, and bytes that were kept between its passes, beside weights."""
    kept = []
    torch.manual_seed(1)
    with torch.autograd.graph.saved_tensors_hooks(
        lambda t: kept.append(0 if t.is_leaf and t.requires_grad else t.nbytes) or t, lambda t: t
    ):
        feats = backbone(image)
    sum(each.square().sum() for each in (feats if isinstance(feats, list) else [feats])).backward()
    return [parameter.grad for parameter in backbone.parameters()], list(backbone.buffers()), sum(kept)


@pytest.mark.parametrize("build", [
    lambda: PooledBackbone("resnet18", timm_args={"drop_block_rate": 0.1, "drop_path_rate": 0.2}),
    lambda: Backbone("mobilenetv3_small_050"),
])  # fmt: skip
def test_a_step_is_the_same_and_less_is_kept(build):
    torch.manual_seed(0)
    plain = build().train()
    again = deepcopy(plain)
    recompute_stages(again.model, again.name, 2)
    assert sum(isinstance(module, RecomputedSequential) for module in again.modules()) == 2
    assert list(again.state_dict()) == list(plain.state_dict())
    image = torch.rand(2, 3, 64, 64)
    (grads, buffers, kept), (expected, expected_buffers, all_kept) = step(again, image), step(plain, image)
    torch.testing.assert_close(grads, expected)
    torch.testing.assert_close(buffers, expected_buffers)  # running statistics, and how many batches they saw
    assert kept < 0.8 * all_kept


def test_copies_and_systems_recompute():
    system = create_model("atloc", backbone="resnet18", width=16, recomputed_stages=1)
    for each in (system, deepcopy(system)):
        (stage,) = (module for module in each.modules() if isinstance(module, RecomputedSequential))
        assert stage is each.network.backbone.body.layer1


def test_stages_that_are_not_there():
    with pytest.raises(InputError, match=r"model.recomputed_stages 5: resnet18 has 4. Choose one of 0 to 4."):
        create_model("atloc", backbone="resnet18", recomputed_stages=5)
