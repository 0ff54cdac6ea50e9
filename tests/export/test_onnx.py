import dataclasses
import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from mambaloc.errors import InputError
from mambaloc.export import Parity, contract_of, export_onnx
from mambaloc.export import onnx as onnx_module
from mambaloc.geometry import canonical
from mambaloc.models.mambaloc import LitMambaLoc

pytestmark = pytest.mark.slow

SIZE = (48, 64)
DATA = {"dataset": "7scenes", "scene": "heads", "short_side": 56}


def tiny(gis: str = "gis", **kwargs) -> LitMambaLoc:
    torch.manual_seed(0)
    system = LitMambaLoc(
        backbone="test_efficientnet", encoder_layers=1, dim=16, heads=2, feedforward=16, head_hidden=16,
        image_size=SIZE, gis=gis, **kwargs,
    )  # fmt: skip
    with torch.no_grad():
        for network in (system.network.head.position, system.network.head.rotation):
            network[0].weight.mul_(5)
            network[2].weight.mul_(5)  # so that images differ visibly in their poses, of both signs of w
            network[2].bias.zero_()
    system.network.head.position_scale.fit(torch.tensor([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0]]))
    return system


def images(batch: int) -> Tensor:
    return torch.rand(batch, 3, *SIZE, generator=torch.Generator().manual_seed(batch))


@dataclasses.dataclass
class Exported:
    path: Path
    system: LitMambaLoc
    parity: Parity
    before: dict[str, Tensor]
    training_after: list[bool]


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Exported:
    path = tmp_path_factory.mktemp("onnx") / "new" / "model.onnx"
    system = tiny().train()
    system.provenance = {"commit": "abc", "seed": 7}
    before = {k: v.clone() for k, v in system.state_dict().items()}
    parity = export_onnx(system, path, contract_of(system, DATA))
    return Exported(path, system, parity, before, [m.training for m in system.network.modules()])


def run(path: Path, image: Tensor) -> tuple[Tensor, Tensor]:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    position_m, quaternion = session.run(["position_m", "quaternion_wxyz"], {"image": image.numpy()})
    return torch.from_numpy(position_m), torch.from_numpy(quaternion)


@pytest.mark.parametrize("batch", [1, 5])
def test_onnx_runtime_agrees_with_pytorch_at_any_batch_size(exported, batch):
    position_m, quaternion = run(exported.path, images(batch))
    with torch.no_grad():
        expected = exported.system.eval()(images(batch))
    assert_close(position_m, expected.position_m, rtol=1e-4, atol=1e-3)
    unit = torch.nn.functional.normalize(expected.quaternion, dim=-1)
    assert_close(quaternion, torch.where(unit[:, :1] < 0, -unit, unit), rtol=1e-4, atol=1e-4)


def test_quaternions_are_unit_and_canonical(exported):
    _, quaternion = run(exported.path, images(5))
    assert_close(quaternion.norm(dim=-1), torch.ones(5))
    assert (quaternion[:, 0] >= 0).all()
    with torch.no_grad():  # and the network's own have both signs or another length
        raw = exported.system.eval()(images(5)).quaternion
    assert not torch.allclose(raw, canonical(raw), atol=1e-3)


def test_the_file_tells_what_it_is(exported):
    model = onnx.load(exported.path)
    onnx.checker.check_model(model)
    assert {o.domain for o in model.opset_import} <= {"", "ai.onnx"}  # runs wherever plain ONNX runs
    metadata = json.loads({p.key: p.value for p in model.metadata_props}["mambaloc"])
    assert metadata["model"] == "mambaloc"
    assert metadata["input"]["shape"] == ["batch", 3, *SIZE]
    assert (metadata["preprocessing"]["short_side"], metadata["scene"]) == (56, "7scenes/heads")
    assert "wxyz" in metadata["pose"]
    assert metadata["trained"] == {"commit": "abc", "seed": 7}
    (image,) = model.graph.input
    first, *rest = image.type.tensor_type.shape.dim
    assert (image.name, bool(first.dim_param), [d.dim_value for d in rest]) == ("image", True, [3, *SIZE])


def test_the_file_is_alone_and_complete(exported):
    assert [p.name for p in exported.path.parent.iterdir()] == ["model.onnx"]
    trained = sum(p.numel() for p in exported.system.network.parameters())
    assert exported.path.stat().st_size > 4 * trained


def test_a_network_that_noise_leads_far_away_may_round_in_proportion(tmp_path):
    """10 km away float32 knows millimetres, ten times as coarse as at 1 km: no difference of the file's."""
    torch.manual_seed(0)
    system = tiny()
    with torch.no_grad():
        for parameter in system.network.head.position.parameters():
            parameter.mul_(1e4)
    parity = export_onnx(system, tmp_path / "model.onnx", contract_of(system, DATA), tolerance_m=1e-5)
    assert parity.max_norm_m > 1e3
    assert 1e-5 < parity.position_m < 1e-5 * parity.max_norm_m


def test_parity_is_reported(exported):
    assert 0 <= exported.parity.position_m < 1e-2
    assert 0 <= exported.parity.rotation_deg < 0.05


def test_the_system_is_left_as_it_was(exported):
    assert all(exported.training_after)
    assert all(torch.equal(v, exported.before[k]) for k, v in exported.system.state_dict().items())


@pytest.mark.parametrize(("gis", "discretisation"), [("classical", "euler"), ("gis", "zoh")])
def test_every_kind_of_gis_is_exported(tmp_path, gis, discretisation):
    system = tiny(gis, discretisation=discretisation)
    parity = export_onnx(system, tmp_path / "model.onnx", contract_of(system, DATA))
    assert parity.rotation_deg < 0.05
    position_m, _ = run(tmp_path / "model.onnx", images(5))
    with torch.no_grad():
        assert_close(position_m, system.eval()(images(5)).position_m, rtol=1e-4, atol=1e-3)


# --- what goes wrong -------------------------------------------------------------------------------------------------


@pytest.fixture
def quick_write(exported, monkeypatch):
    """Skip the slow conversion: every file written is that of ``exported``."""
    monkeypatch.setattr(onnx_module, "_write", lambda deployed, contract, path: path.write_bytes(content))
    content = exported.path.read_bytes()
    return exported.system


def refused(system: LitMambaLoc, path: Path, match: str, **kwargs) -> None:
    with pytest.raises(InputError, match=match) as error:
        export_onnx(system, path, contract_of(system, DATA), **kwargs)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("tolerance", [{"tolerance_m": -1.0}, {"tolerance_deg": -1.0}], ids=str)
def test_a_file_out_of_tolerance_is_not_left_behind(quick_write, tmp_path, tolerance):
    refused(quick_write, tmp_path / "model.onnx", "differs from PyTorch", **tolerance)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("branch", ["position", "rotation"])
def test_a_file_of_other_weights_is_found_out(quick_write, tmp_path, branch):
    system = tiny()
    with torch.no_grad():
        getattr(system.network.head, branch)[2].bias.add_(
            torch.tensor([0.0, 1.0, 0.0, 0.0])[: 3 if "pos" in branch else 4]
        )
    refused(system, tmp_path / "model.onnx", "differs from PyTorch")
    assert not list(tmp_path.iterdir())


def test_a_diverged_network_is_found_out(quick_write, tmp_path):
    system = tiny()
    with torch.no_grad():
        system.network.head.position[2].bias.fill_(np.nan)
    refused(system, tmp_path / "model.onnx", "differs from PyTorch")


def test_a_failure_leaves_the_previous_file(quick_write, tmp_path):
    (tmp_path / "model.onnx").write_text("previous")
    refused(quick_write, tmp_path / "model.onnx", "differs", tolerance_m=-1.0)
    assert (tmp_path / "model.onnx").read_text() == "previous"
    assert export_onnx(quick_write, tmp_path / "model.onnx", contract_of(quick_write, DATA)) is not None
    assert (tmp_path / "model.onnx").stat().st_size > 1000


def test_a_path_that_cannot_be_written_is_refused(quick_write, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    refused(quick_write, tmp_path / "file" / "model.onnx", "cannot be written")
    refused(quick_write, tmp_path / "folder", "cannot be written")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


def test_a_read_only_folder_is_refused(quick_write, tmp_path, monkeypatch):
    def denied(deployed, system, path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(onnx_module, "_write", denied)  # root, as in a container, may write anywhere
    refused(quick_write, tmp_path / "model.onnx", "Permission denied")
