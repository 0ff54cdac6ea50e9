import pytest
import torch
from safetensors.torch import save_file
from torch import nn
from torchvision.models import GoogLeNet

import mambaloc
from mambaloc.benchmark.latency import random_frames
from mambaloc.errors import InputError
from mambaloc.export import contract_of, export_onnx
from mambaloc.models.posenet import GoogLeNetBackbone

SMALL = {"backbone": "test_efficientnet", "image_size": 64, "width": 32}


@pytest.fixture(scope="module")
def googlenet():
    torch.manual_seed(0)
    return mambaloc.create_model("posenet", variant="googlenet", image_size=64, width=32)


def test_googlenet_regresses_from_its_auxiliary_branches_while_training(googlenet):
    image = random_frames(3, 64).image
    prediction = googlenet.train()(image)
    assert [(a.position_m.shape, a.quaternion.shape) for a in prediction.auxiliary] == [((3, 3), (3, 4))] * 2
    assert googlenet.eval()(image).auxiliary == ()


def test_auxiliary_branches_weigh_three_tenths(googlenet, monkeypatch):
    monkeypatch.setattr(googlenet, "log", lambda *args, **kwargs: None)
    googlenet.train()
    frames = random_frames(3, 64)
    torch.manual_seed(1)
    total = googlenet.training_step(frames, 0)
    torch.manual_seed(1)
    prediction = googlenet(frames.image)
    main, *auxiliary = (googlenet.loss(each, frames) for each in (prediction, *prediction.auxiliary))
    torch.testing.assert_close(total, main + 0.3 * (auxiliary[0] + auxiliary[1]))


def test_every_parameter_of_googlenet_is_trained(googlenet, monkeypatch):
    monkeypatch.setattr(googlenet, "log", lambda *args, **kwargs: None)
    googlenet.train().training_step(random_frames(3, 64), 0).backward()
    assert [name for name, p in googlenet.named_parameters() if p.grad is None] == []


def test_googlenets_feature_is_that_of_torchvision(tmp_path):
    torch.manual_seed(0)
    theirs = GoogLeNet(aux_logits=True, init_weights=False).eval()
    save_file(theirs.state_dict(), tmp_path / "googlenet.safetensors")
    ours = GoogLeNetBackbone(str(tmp_path / "googlenet.safetensors")).eval()
    theirs.fc = nn.Identity()
    image = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.testing.assert_close(ours(image), theirs(image * 2 - 1), rtol=1e-4, atol=1e-5)


def test_googlenets_weights_that_are_not_there_are_named():
    with pytest.raises(InputError, match=r"backbone_weights nowhere.safetensors: no such file"):
        GoogLeNetBackbone("nowhere.safetensors")


def test_googlenet_has_no_weights_of_timms():
    with pytest.raises(InputError, match="GoogLeNet's are torchvision's"):
        GoogLeNetBackbone("timm")


def test_an_unknown_variant_is_named():
    with pytest.raises(InputError, match=r"model\.variant 'googlnet': choose one of timm, googlenet"):
        mambaloc.create_model("posenet", variant="googlnet")


@pytest.mark.parametrize(
    ("name", "given", "kept"),
    [
        ("posenet_learned", {"s_position": -1.0}, ("l1", -1.0, -3.0)),
        ("posenet_learned", None, ("l1", 0.0, -3.0)),
        ("transbonet", {"nearest_sign": True}, ("l1", 0.0, -3.0)),
    ],
)
def test_changing_one_loss_argument_leaves_the_others(name, given, kept):
    loss = mambaloc.create_model(name, **SMALL, loss_args=given).loss
    assert (loss.norm, loss.s_position.item(), loss.s_rotation.item()) == kept


@pytest.mark.slow
def test_googlenet_is_exported(googlenet, tmp_path):
    contract = contract_of(googlenet, {"dataset": "7scenes", "scene": "heads", "short_side": 64})
    assert export_onnx(googlenet, tmp_path / "model.onnx", contract).position_m < 1e-4


# --- a warm start ----------------------------------------------------------------------------------------------------


@pytest.fixture
def learned(tmp_path):
    import lightning as L
    from torch.utils.data import DataLoader

    system = mambaloc.create_model("posenet_learned", **SMALL)
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = L.Trainer(accelerator="cpu", max_epochs=1, enable_model_summary=False, **quiet)
    trainer.fit(system, DataLoader([random_frames(3, 64)], batch_size=None))
    trainer.save_checkpoint(tmp_path / "learned.ckpt")
    return system, tmp_path / "learned.ckpt"


def test_a_warm_start_takes_the_networks_weights(learned):
    system, checkpoint = learned
    warm = mambaloc.create_model("posenet_geometric", **SMALL, warm_start=str(checkpoint))
    expected = system.network.state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in warm.network.state_dict().items())


def test_a_warm_start_from_another_network_is_named(learned):
    with pytest.raises(InputError, match=r"learned.ckpt: has another network .*size mismatch") as error:
        mambaloc.create_model("posenet_geometric", **{**SMALL, "width": 16}, warm_start=str(learned[1]))
    assert "\n" not in str(error.value)


def test_a_warm_start_that_is_not_there_says_how_to_get_it():
    with pytest.raises(InputError, match=r"runs/none.ckpt: no such checkpoint"):
        mambaloc.create_model("posenet_geometric", **SMALL, warm_start="runs/none.ckpt")
