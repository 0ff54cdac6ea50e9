import pytest
import torch
from torch import Tensor, nn
from torch.export import Dim, export
from torch.testing import assert_close

from mambaloc.nn import GlobalInformationSelector, build_gis

BOTH = pytest.mark.parametrize("discretisation", ["euler", "zoh"])


def features(batch: int, dim: int, seed: int = 0) -> Tensor:
    return torch.randn(batch, dim, generator=torch.Generator().manual_seed(seed))


def gis(mode: str, dim: int, **kwargs) -> GlobalInformationSelector:
    torch.manual_seed(0)
    return GlobalInformationSelector(dim, mode, **kwargs)


@pytest.mark.parametrize(("dim", "count"), [(256, 437_760), (1024, 6_666_240), (2048, 26_439_680)])
def test_two_blocks_add_exactly_what_the_paper_counts(dim, count):
    with torch.device("meta"):
        blocks = nn.ModuleList(build_gis("gis", dim) for _ in range(2))
    assert sum(p.numel() for p in blocks.parameters()) == count


def test_classical_has_the_same_parameters():
    shapes = [{n: p.shape for n, p in gis(mode, 32).named_parameters()} for mode in ("gis", "classical")]
    assert shapes[0] == shapes[1]


@BOTH
def test_gis_is_the_second_token_of_the_flipped_and_the_plain_feature(discretisation):
    block, g = gis("gis", 48, discretisation=discretisation), features(5, 48)
    flipped = g[:, list(range(47, -1, -1))]
    with torch.no_grad():
        assert_close(block(g), block.mixer(torch.stack((flipped, g), dim=1))[:, 1], rtol=1e-5, atol=1e-7)
        assert (block(g) - block.mixer(torch.stack((g, flipped), dim=1))[:, 1]).abs().max() > 1e-4
        assert (block(g) - block.mixer(torch.stack((g, g), dim=1))[:, 1]).abs().max() > 1e-5


@BOTH
def test_classical_is_the_mixer_on_the_feature_alone(discretisation):
    block, g = gis("classical", 48, discretisation=discretisation), features(5, 48)
    with torch.no_grad():
        assert_close(block(g), block.mixer(g[:, None])[:, 0], rtol=0, atol=0)
        assert (block(g) - gis("gis", 48)(g)).abs().max() > 1e-5  # the ablation does something else


def test_none_is_the_identity_without_parameters():
    block, g = build_gis("none", 48), features(5, 48)
    assert not list(block.parameters())
    assert torch.equal(block(g), g)


def test_images_do_not_see_one_another():
    block, g = gis("gis", 32), features(4, 32)
    with torch.no_grad():
        assert_close(block(g)[2:3], block(g[2:3]), rtol=1e-5, atol=1e-7)


def gradients(block: nn.Module, dim: int) -> dict[str, Tensor]:
    (block(features(4, dim)) * features(4, dim, seed=1)).sum().backward()
    return {n: torch.zeros_like(p) if p.grad is None else p.grad for n, p in block.mixer.named_parameters()}


@BOTH
def test_gis_trains_everything_but_the_first_two_taps(discretisation):
    grads = gradients(gis("gis", 32, discretisation=discretisation), 32)
    taps = grads.pop("conv1d.weight")[:, 0]
    assert (taps[:, :2] == 0).all()
    assert (taps[:, 2:] != 0).all()
    assert {name for name, grad in grads.items() if not (grad != 0).any()} == set()
    assert (grads["A_log"] != 0).all()


@BOTH
def test_classical_trains_no_tap_but_the_last(discretisation):
    grads = gradients(gis("classical", 32, discretisation=discretisation), 32)
    taps = grads.pop("conv1d.weight")[:, 0]
    assert (taps[:, :3] == 0).all()
    assert (taps[:, 3] != 0).all()
    # From a zero state nothing decays: A only enters zero-order hold's B_bar.
    untrained = {"A_log"} if discretisation == "euler" else set()
    assert {name for name, grad in grads.items() if not (grad != 0).any()} == untrained


@BOTH
@pytest.mark.parametrize("mode", ["classical", "gis"])
def test_exports_with_any_batch_size(mode, discretisation):
    block = gis(mode, 16, discretisation=discretisation).eval()
    program = export(block, (features(2, 16),), dynamic_shapes={"feats_BD": {0: Dim("batch")}})
    for batch in (1, 5):
        g = features(batch, 16, seed=batch)
        assert_close(program.module()(g), block(g), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("build", [GlobalInformationSelector, lambda dim, mode: build_gis(mode, dim)])
def test_an_unknown_mode_is_named(build):
    with pytest.raises(ValueError, match="bidirectional"):
        build(8, "bidirectional")


@pytest.mark.parametrize("mode", ["classical", "gis"])
def test_build_gis_hands_mode_and_discretization_on(mode):
    block = build_gis(mode, 8, "zoh")
    assert (block.mode, block.mixer.discretisation) == (mode, "zoh")
