import pickle
from pathlib import Path

import pytest
import timm
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.testing import assert_close

from mambaloc.errors import InputError
from mambaloc.nn import Backbone

WEIGHTS = Path(__file__).parents[2].parent / "shared" / "weights" / "mobilenetv2_100.imagenet_tf2ptq.safetensors"
SMALL = "mobilenetv3_small_050"

# Where each full classifier's last feature at strides 8 and 16 leaves it, and that feature's depth.
TAPS = {
    "efficientnet_b0": (("blocks.2", 40), ("blocks.4", 112)),
    "mobilenetv2_100": (("blocks.2", 32), ("blocks.4", 96)),
    "resnet18": (("layer2", 128), ("layer3", 256)),
    "convnext_atto": (("stages.1", 80), ("stages.2", 160)),
}


def image(height: int = 64, width: int = 64) -> Tensor:
    return torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(0))


def refused(match: str, name: str = SMALL, **kwargs) -> None:
    with pytest.raises(InputError, match=match) as error:
        Backbone(name, **kwargs)
    assert "\n" not in str(error.value)


# --- what is built ---------------------------------------------------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize("name", TAPS)
def test_maps_are_those_of_the_full_model(name):
    torch.manual_seed(0)
    full, tapped = timm.create_model(name).double().eval(), {}  # the two may run other kernels: in float64
    for tap, _ in TAPS[name]:
        full.get_submodule(tap).register_forward_hook(lambda m, i, out, tap=tap: tapped.__setitem__(tap, out))
    backbone = Backbone(name).double().eval()
    assert not backbone.body.model.load_state_dict(full.state_dict(), strict=False).missing_keys

    mean, std = (torch.tensor(full.pretrained_cfg[key]).view(3, 1, 1) for key in ("mean", "std"))
    full((image(64, 96).double() - mean) / std)
    maps = backbone(image(64, 96).double())
    assert [m.shape[-2:] for m in maps] == [(8, 12), (4, 6)]
    assert backbone.channels == [depth for _, depth in TAPS[name]]
    for actual, (tap, _) in zip(maps, TAPS[name], strict=True):
        assert_close(actual, tapped[tap], rtol=1e-5, atol=1e-6)


def test_stages_past_the_last_stride_do_not_exist():
    backbone, full = Backbone("efficientnet_b0"), timm.create_model("efficientnet_b0")
    assert sum(p.numel() for p in backbone.parameters()) == 851_808
    assert sum(p.numel() for p in full.parameters()) - 851_808 == 4_436_740
    used = [*full.conv_stem.parameters(), *full.bn1.parameters(), *full.blocks[:5].parameters()]
    assert sum(p.numel() for p in used) == 851_808


def test_every_parameter_touches_the_maps():
    backbone = Backbone(SMALL)
    sum((m * torch.randn_like(m)).sum() for m in backbone(image())).backward()
    assert {n for n, p in backbone.named_parameters() if p.grad is None or not p.grad.any()} == set()


@pytest.mark.parametrize("strides", [(4,), (32,), (16,), (4, 32)])
def test_other_strides(strides):
    backbone = Backbone(SMALL, strides)
    maps = backbone.eval()(image())
    assert [(m.shape[1], m.shape[-1]) for m in maps] == [
        (c, 64 // s) for c, s in zip(backbone.channels, strides, strict=True)
    ]


def test_the_deepest_stage_at_a_stride_is_read():
    assert len(Backbone("vit_tiny_patch16_224", (16,)).body.model.blocks) == 12  # all of them are at stride 16


@pytest.mark.parametrize("size", [(64, 64), (48, 80), (65, 97)])
def test_grids_are_the_maps_sizes_and_leave_no_trace(size):
    backbone = Backbone(SMALL)
    before = {k: v.clone() for k, v in backbone.state_dict().items()}
    assert backbone.grids(size) == [tuple(m.shape[-2:]) for m in backbone.eval()(image(*size))]
    assert all(torch.equal(v, before[k]) for k, v in backbone.state_dict().items())
    assert backbone.train().grids(size)
    assert backbone.training


@torch.no_grad()
@pytest.mark.parametrize("given", [None, (0.1, 0.5, 0.7)])
def test_images_are_normalized_by_mean_and_deviation(given):
    backbone = Backbone(SMALL, pixel_mean=given, pixel_std=given).eval()
    config = timm.get_pretrained_cfg(SMALL)
    mean, std = (torch.tensor(given or value).view(1, 3, 1, 1) for value in (config.mean, config.std))
    unit = torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    for actual, expected in zip(backbone(unit * std + mean), backbone.body(unit), strict=True):
        assert_close(actual, expected, rtol=1e-4, atol=1e-4)


def test_timm_arguments_are_passed_on():
    paddings = [
        Backbone("efficientnet_b0", (8,), timm_args=args).body.model.conv_stem.padding
        for args in (None, {"pad_type": "same"})
    ]
    assert paddings[0] != paddings[1]


# --- weights ---------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not WEIGHTS.is_file(), reason=f"{WEIGHTS} is not on this machine")
def test_shared_weights_are_loaded():
    backbone = Backbone("mobilenetv2_100", weights=str(WEIGHTS), timm_args={"pad_type": "same"})
    stored = load_file(WEIGHTS)
    loaded = {k: v for k, v in backbone.body.model.state_dict().items() if not k.endswith("num_batches_tracked")}
    assert loaded
    assert all(torch.equal(value, stored[name]) for name, value in loaded.items())
    assert set(stored) - set(loaded)  # the stages past stride 16 stay in the file


def test_weights_of_a_full_model_are_loaded(tmp_path):
    full = timm.create_model(SMALL)
    save_file(full.state_dict(), tmp_path / "full.safetensors")
    backbone = Backbone(SMALL, weights=str(tmp_path / "full.safetensors"))
    expected = full.state_dict()
    assert all(torch.equal(v, expected[k]) for k, v in backbone.body.model.state_dict().items())


def test_a_missing_file_is_refused(tmp_path):
    refused("no such file", weights=str(tmp_path / "gone.safetensors"))


@pytest.mark.parametrize("suffix", [".pth", ".bin", ""])
def test_pickles_are_refused_by_name(tmp_path, suffix):
    path = tmp_path / f"weights{suffix}"
    torch.save(timm.create_model(SMALL).state_dict(), path)
    refused("only .safetensors", weights=str(path))


@pytest.mark.parametrize("kind", ["pickle", "empty", "truncated"])
def test_files_that_are_no_safetensors_are_refused(tmp_path, kind):
    path = tmp_path / "weights.safetensors"
    save_file(timm.create_model(SMALL).state_dict(), path)
    path.write_bytes({"pickle": pickle.dumps({"a": 1}), "empty": b"", "truncated": path.read_bytes()[:-1000]}[kind])
    refused("does not fit", weights=str(path))


def test_a_folder_is_refused(tmp_path):
    (tmp_path / "weights.safetensors").mkdir()
    refused(r"weights\.safetensors", weights=str(tmp_path / "weights.safetensors"))


def test_weights_of_other_shapes_are_refused_and_a_tensor_named(tmp_path):
    path = tmp_path / "wide.safetensors"
    save_file(timm.create_model("mobilenetv3_small_075").state_dict(), path)
    refused("does not fit.*size mismatch", weights=str(path))


def test_weights_that_lack_tensors_are_refused_and_one_named(tmp_path):
    state = timm.create_model(SMALL).state_dict()
    del state["conv_stem.weight"]
    save_file(state, tmp_path / "part.safetensors")
    refused(
        "1 tensors of mobilenetv3_small_050 are missing, such as conv_stem.weight",
        weights=str(tmp_path / "part.safetensors"),
    )


def test_timm_weights_that_cannot_be_fetched_are_one_line(offline_timm):
    refused("could not be fetched", weights="timm")


# --- arguments -------------------------------------------------------------------------------------------------------


def test_an_unknown_model_is_refused_with_near_ones():
    refused(r"no such model.*efficientnet_b\d", name="efficientnet_bo")


@pytest.mark.parametrize("strides", [(16, 8), (8, 8)])
def test_strides_that_do_not_rise_are_refused(strides):
    with pytest.raises(ValueError, match="rise"):
        Backbone(SMALL, strides)


def test_strides_that_the_model_lacks_are_refused():
    refused(r"strides \(3, 16\)", strides=(3, 16))
    refused(r"strides \(8, 16\), has", name="vit_tiny_patch16_224")


def test_arguments_that_timm_does_not_take_are_refused():
    refused("backbone_args.*padding_kind", timm_args={"padding_kind": "same"})
