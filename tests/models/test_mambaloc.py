import lightning as L
import numpy as np
import pytest
import timm
import torch
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close
from torch.utils.data import DataLoader

from mambaloc.errors import InputError
from mambaloc.models import Checkpoint
from mambaloc.models.mambaloc import LitMambaLoc, MambaLoc
from mambaloc.models.weights import mib, parameter_count
from mambaloc.nn import PositionScale
from mambaloc.types import PoseBatch

SMALL = {
    "backbone": "mobilenetv3_small_050", "encoder_layers": 1, "dim": 16, "heads": 2, "feedforward": 16,
    "head_hidden": 16, "image_size": 64,
}  # fmt: skip


def small(**kwargs) -> LitMambaLoc:
    torch.manual_seed(0)
    return LitMambaLoc(**{**SMALL, **kwargs})


def images(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def batches(count: int = 2, size: int = 4) -> list[PoseBatch]:
    generator = torch.Generator().manual_seed(0)
    return [
        PoseBatch(
            images(size, 3, 64, 64, seed=i),
            torch.randn(size, 3, generator=generator) * 2 + 5,
            torch.nn.functional.normalize(torch.randn(size, 4, generator=generator), dim=-1),
            torch.arange(size) + i * size,
        )
        for i in range(count)
    ]


class Scene(L.LightningDataModule):
    def __init__(self) -> None:
        super().__init__()
        self.batches = batches()
        self.train_position_m = torch.cat([b.position_m for b in self.batches])

    def train_dataloader(self) -> DataLoader:
        return DataLoader(self.batches, batch_size=None)

    val_dataloader = test_dataloader = train_dataloader


def trainer(folder, **kwargs) -> L.Trainer:
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    return L.Trainer(
        default_root_dir=folder, accelerator="cpu", max_epochs=1, enable_model_summary=False, **quiet, **kwargs
    )


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


# --- sizes -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def full_size() -> dict[str, MambaLoc]:
    return {mode: LitMambaLoc(gis=mode).network for mode in ("none", "classical", "gis")}


def test_shipped_parameters(full_size):
    assert {mode: count(network) for mode, network in full_size.items()} == {
        "none": 6_624_615 - 437_760,
        "classical": 6_624_615,
        "gis": 6_624_615,
    }
    assert round(mib(parameter_count(full_size["gis"])), 1) == 25.3


@pytest.mark.parametrize(("mode", "published"), [("gis", 11_073_131), ("none", 10_635_371)])
def test_published_accounting(full_size, mode, published):
    network = full_size[mode]
    tables = count(network.position_encoder.positions) + count(network.orientation_encoder.positions)
    never_used = count(timm.create_model("efficientnet_b0")) - count(network.backbone)
    assert never_used == 4_436_740
    assert count(network) - tables + never_used + 3 * 60 * 128 == published


def test_position_is_read_at_stride_16_and_orientation_at_stride_8(full_size):
    network = full_size["gis"]
    for encoder, channels, side in ((network.position_encoder, 112, 14), (network.orientation_encoder, 40, 28)):
        assert encoder.project.in_channels == channels
        assert encoder.positions.row.shape == encoder.positions.column.shape == (side + 1, 128)
        assert len(encoder.layers) == 6


def test_frozen_parameters_are_not_counted():
    layer = torch.nn.Linear(2**9, 2**9, bias=False)
    layer.register_parameter("frozen", torch.nn.Parameter(torch.zeros(7), requires_grad=False))
    assert mib(parameter_count(layer)) == 1.0


# --- the network -----------------------------------------------------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize("size", [(128, 160), 96, (64, 64)])
def test_image_sizes(size):
    system = small(image_size=size).eval()
    height, width = size if isinstance(size, tuple) else (size, size)
    assert system.image_size == (height, width)
    prediction = system(images(3, 3, height, width))
    assert (prediction.position_m.shape, prediction.quaternion.shape) == ((3, 3), (3, 4))
    feats = system.network.backbone(images(3, 3, height, width))
    assert [f.shape for f in system.network.features(feats)] == [(3, 16)] * 2


def test_images_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"\(64, 96\).*\(64, 64\)"):
        small()(images(1, 3, 64, 96))


@torch.no_grad()
@pytest.mark.parametrize("branch", ["position", "orientation"])
@pytest.mark.parametrize("block", ["encoder", "gis", "head"])
def test_branches_are_apart(branch, block):
    network = small().network.eval()
    before = network(images(2, 3, 64, 64))
    name = f"{branch}_{block}" if block != "head" else f"head.{'position' if branch == 'position' else 'rotation'}"
    for parameter in network.get_submodule(name).parameters():
        parameter.mul_(1.5)
    after = network(images(2, 3, 64, 64))
    changed = {
        "position": not torch.equal(before.position_m, after.position_m),
        "orientation": not torch.equal(before.quaternion, after.quaternion),
    }
    assert changed == {"position": branch == "position", "orientation": branch == "orientation"}


@torch.no_grad()
def test_gis_is_the_network_without_it_and_a_block_before_each_head():
    with_gis, without = small().network.eval(), small(gis="none").network.eval()
    without.load_state_dict(with_gis.state_dict(), strict=False)
    feats = without.backbone(images(2, 3, 64, 64))
    plain = without.features(feats)
    selected = [gis(f) for gis, f in zip((with_gis.position_gis, with_gis.orientation_gis), plain, strict=True)]
    for actual, expected in zip(with_gis.features(feats), selected, strict=True):
        assert_close(actual, expected, rtol=1e-5, atol=1e-7)
    prediction = with_gis(images(2, 3, 64, 64))
    assert_close(prediction.position_m, with_gis.head.position(selected[0]), rtol=1e-5, atol=1e-6)
    assert_close(prediction.quaternion, with_gis.head.rotation(selected[1]), rtol=1e-5, atol=1e-6)


def test_options_reach_the_blocks():
    network = small(discretisation="zoh", gis="classical", dropout=0.3, attention_dropout=0.2).network
    assert {network.position_gis.mixer.discretisation, network.orientation_gis.mixer.discretisation} == {"zoh"}
    assert {network.position_gis.mode, network.orientation_gis.mode} == {"classical"}
    layer = network.orientation_encoder.layers[0]
    assert (layer.dropout.p, layer.mlp[2].p, layer.attention_dropout) == (0.3, 0.3, 0.2)


def test_user_mistakes_come_through():
    with pytest.raises(InputError, match="no such model"):
        small(backbone="mobilenet_v9")
    with pytest.raises(InputError, match="loss 'huber'"):
        small(loss="huber")
    with pytest.raises(InputError, match=r"model\.beta2 1: must be 0 or more and less than 1"):
        small(beta2=1.0)


# --- training --------------------------------------------------------------------------------------------------------


def test_paper_defaults():
    system = small()
    optimizer, scheduler = system.configure_optimizers().values()
    assert isinstance(optimizer, torch.optim.Adam)
    assert all((g["lr"], g["betas"], g["eps"]) == (1e-4, (0.9, 0.999), 1e-10) for g in optimizer.param_groups)
    assert [g["weight_decay"] for g in optimizer.param_groups] == [1e-4, 0.0]
    assert (scheduler.step_size, scheduler.gamma) == (100, 0.1)
    assert (system.loss.s_position.item(), system.loss.s_rotation.item()) == (-0.5, -6.5)
    assert {g["betas"] for g in small(beta2=0.99).configure_optimizers()["optimizer"].param_groups} == {(0.9, 0.99)}


def test_backbones_that_name_undecayed_parameters_by_dotted_names_train():
    system = small(backbone="efficientformerv2_s0", image_size=224)  # timm fixes its attention to 224 px
    undecayed = {id(p) for p in system.configure_optimizers()["optimizer"].param_groups[1]["params"]}
    biases = [p for n, p in system.named_parameters() if n.endswith("attention_biases")]
    assert biases
    assert {id(p) for p in biases} <= undecayed


def test_validation_logs_the_medians_of_the_whole_set(tmp_path):
    system, scene = small().eval(), Scene()
    with torch.no_grad():
        predictions = [system(b.image) for b in scene.batches]
    predicted_m, true_m = (torch.cat([x.position_m for x in xs]).numpy() for xs in (predictions, scene.batches))
    predicted, true = (
        Rotation.from_quat(torch.cat([x.quaternion for x in xs]).numpy(), scalar_first=True)
        for xs in (predictions, scene.batches)
    )
    error_m = np.linalg.norm(predicted_m - true_m, axis=-1)
    error_deg = np.degrees((predicted.inv() * true).magnitude())
    for split, run in (("val", trainer(tmp_path).validate), ("test", trainer(tmp_path).test)):
        (logged,) = run(system, datamodule=scene, verbose=False)
        assert logged[f"{split}/position_error_m"] == pytest.approx(np.median(error_m), rel=1e-5)
        assert logged[f"{split}/rotation_error_deg"] == pytest.approx(np.median(error_deg), rel=1e-4)
        assert f"{split}/recall_5cm_5deg" in logged


def test_position_scale_by_hand():
    scale = PositionScale()
    assert torch.equal(scale(torch.eye(3)), torch.eye(3))
    scale.fit(torch.tensor([[4.0, 1.0, 0.0], [0.0, 1.0, 0.0], [2.0, 1.0, 3.0], [2.0, 1.0, -3.0]]))
    assert_close(scale.mean_m, torch.tensor([2.0, 1.0, 0.0]))
    assert_close(scale.scale_m, torch.tensor(6.5).sqrt())  # mean of 4, 4, 9, 9
    assert_close(scale(torch.tensor([[0.0, 0.0, 2.0]])), torch.tensor([[2.0, 1.0, 2 * 6.5**0.5]]))
    scale.fit(torch.ones(3, 3))
    assert_close(scale.scale_m, torch.tensor(1e-3))  # a camera that stands still divides by no zero


@pytest.mark.parametrize("normalize", [True, False])
def test_position_statistics_are_taken_from_training_and_saved(tmp_path, normalize):
    system, scene = small(normalise_position=normalize), Scene()
    run = trainer(tmp_path)
    run.fit(system, datamodule=scene)
    run.save_checkpoint(tmp_path / "last.ckpt")
    mean_m = Checkpoint.read(tmp_path / "last.ckpt").system().network.head.position_scale.mean_m
    assert_close(mean_m, scene.train_position_m.mean(0) if normalize else torch.zeros(3))


def test_the_same_start_gives_the_same_training(tmp_path):
    def train(start: int) -> dict[str, Tensor]:
        system = small(dropout=0.5, lr=1e-2)
        torch.manual_seed(start)  # dropout is tied to the epoch, whatever was drawn before
        trainer(tmp_path).fit(system, datamodule=Scene())
        return system.state_dict()

    first, second = train(1), train(2)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_backbone_weights_are_not_looked_for_again(tmp_path):
    weights = tmp_path / "start.safetensors"
    save_file(timm.create_model(SMALL["backbone"]).state_dict(), weights)
    system = small(backbone_weights=str(weights))
    run = trainer(tmp_path)
    run.strategy.connect(system)
    run.save_checkpoint(tmp_path / "last.ckpt")
    weights.unlink()
    loaded = Checkpoint.read(tmp_path / "last.ckpt").system()
    assert all(torch.equal(v, loaded.state_dict()[k]) for k, v in system.state_dict().items())
