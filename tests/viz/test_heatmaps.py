"""Heat maps and principal components: closed forms, and every registered system."""

import inspect

import lightning as L
import numpy as np
import pytest
import torch
from torch import nn

import mambaloc
from mambaloc.errors import InputError
from mambaloc.models.registry import model_class
from mambaloc.nn import Backbone, PoseHead, PoseNetwork, TokenEncoder
from mambaloc.viz.features import position_features, principal_colors, principal_components
from mambaloc.viz.heatmaps import Reading, grad_cam, heat_maps, readings

SMALL = {
    "encoder_layers": 1, "dim": 32, "heads": 4, "feedforward": 32, "head_hidden": 32, "width": 64, "hidden": 16,
    "stage_channels": 64, "blocks": 2, "groups": 4,
}  # fmt: skip
SIDE = 128


def small(name, gis):
    bases = [c for c in model_class(name).__mro__ if issubclass(c, L.LightningModule)]
    taken = {parameter for base in bases for parameter in inspect.signature(base).parameters}
    torch.manual_seed(0)
    arguments = {key: value for key, value in SMALL.items() if key in taken}
    return mambaloc.create_model(name, gis=gis, image_size=SIDE, backbone="mobilenetv3_small_050", **arguments).eval()


class Linear(PoseNetwork):
    """Position is a weighed sum of the mean of each channel of a backbone's map; orientation is fixed."""

    def __init__(self, weight):
        super().__init__()
        self.backbone = Backbone("mobilenetv3_small_050", strides=(16,))
        self.head = PoseHead(self.backbone.channels[0])
        with torch.no_grad():
            self.head.position[0].weight.copy_(weight.expand(3, -1) * torch.tensor([[1.0], [0.0], [0.0]]))
            self.head.position[0].bias.zero_()

    def features(self, feats):
        (feats_BCHW,) = feats
        return (feats_BCHW.mean((-2, -1)),) * 2


def test_a_linear_branchs_map_is_its_weighed_channels():
    weight = torch.randn(24, generator=torch.Generator().manual_seed(0))
    network = Linear(weight).eval()
    image = torch.rand(2, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        (feats_BCHW,) = network.backbone(image)
    expected_BHW = (weight[:, None, None] * feats_BCHW).sum(1).abs()  # |x| grows with w . mean; its sign is lost in abs
    expected_BHW /= expected_BHW.amax((-2, -1), keepdim=True)
    torch.testing.assert_close(heat_maps(network, image)[0], expected_BHW, rtol=1e-4, atol=1e-5)


def test_grad_cam_by_hand():
    feats = torch.tensor([[[[1.0, 0.0]], [[0.0, 2.0]]]])
    gradient = torch.tensor([[[[1.0, 3.0]], [[-1.0, -1.0]]]])  # channel weights 2 and -1
    assert grad_cam(Reading(feats, gradient)).tolist() == [[[1.0, 1.0]]]  # |2| and |-2|, over the largest


@pytest.mark.parametrize("gis", ["none", "classical", "gis"])
@pytest.mark.parametrize("name", mambaloc.list_models())
def test_every_system_is_looked_into(name, gis):
    network = small(name, gis).network
    image = torch.rand(2, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    for heat_BHW in heat_maps(network, image):
        assert heat_BHW.shape[0] == 2
        assert min(heat_BHW.shape[1:]) > 1
        assert heat_BHW.isfinite().all()
        assert (heat_BHW.amax((-2, -1)) == 1).all()
        assert (heat_BHW.std((-2, -1)) > 0).all()
    colors = principal_colors(position_features(network, image)[0], (SIDE, SIDE))
    assert colors.shape == (SIDE, SIDE, 3)
    assert 0 <= colors.min() < colors.max() <= 1
    assert all(parameter.grad is None for parameter in network.parameters())


def test_transposenets_branches_read_different_maps():
    position, orientation = readings(small("mambaloc", "gis").network, torch.rand(1, 3, SIDE, SIDE))
    assert position.feats.shape[-2:] == (SIDE // 16, SIDE // 16)
    assert orientation.feats.shape[-2:] == (SIDE // 8, SIDE // 8)


def test_a_backbone_without_a_map_is_refused():
    network = small("student", "none").network
    network.backbone = nn.Sequential(nn.Flatten(), nn.Linear(3 * SIDE * SIDE, 8))
    with pytest.raises(InputError, match="has no spatial feature map"):
        heat_maps(network, torch.rand(1, 3, SIDE, SIDE))


def test_components_are_those_of_the_covariance():
    feats = torch.randn(6, 5, 7, generator=torch.Generator().manual_seed(0)) ** 3
    found = principal_components(feats).flatten(1).numpy()
    cells = feats.flatten(1).T.double().numpy()
    values, vectors = np.linalg.eigh(np.cov(cells.T))
    expected = (cells - cells.mean(0)) @ vectors[:, ::-1][:, :3]
    for ours, theirs in zip(found, expected.T, strict=True):
        assert abs(np.corrcoef(ours, theirs)[0, 1]) == pytest.approx(1)
        assert (ours**3).sum() >= 0
    np.testing.assert_allclose(found.var(axis=1, ddof=1), values[::-1][:3], rtol=1e-4)
    with pytest.raises(InputError, match="has no 3 components"):
        principal_components(torch.rand(6, 1, 3))


def test_cells_are_what_the_encoder_leaves_out():
    torch.manual_seed(0)
    encoder = TokenEncoder(8, (3, 4), dim=16, layers=2, heads=2, feedforward=16).eval()
    feats = torch.randn(2, 8, 3, 4)
    whole = torch.cat((encoder.token.expand(2, -1, -1), encoder.project(feats).flatten(2).mT), dim=1)
    for layer in encoder.layers:
        whole = layer(whole, encoder.positions())
    whole = encoder.norm(whole)
    torch.testing.assert_close(encoder(feats), whole[:, 0])
    torch.testing.assert_close(encoder.cells(feats), whole[:, 1:].mT.unflatten(-1, (3, 4)))
