"""ONNX export, checked against PyTorch before the file is given its name."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import io
import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnxruntime
import torch
from torch import Tensor, nn
from torch.export import Dim
from typing_extensions import deprecated

from mambaloc.data import MultiSceneDataModule, PoseDataModule
from mambaloc.errors import InputError
from mambaloc.files import atomic_file, writing
from mambaloc.geometry import canonical, rotation_error_deg
from mambaloc.models import LitPoseRegressor
from mambaloc.nn import PoseNetwork, PositionScale
from mambaloc.runtime.contract import (
    IMAGE_INPUT,
    INTRINSICS_INPUT,
    METADATA_KEY,
    Contract,
    Preprocessing,
    SceneFrame,
)
from mambaloc.runtime.undistortion import Undistortion
from mambaloc.runtime.world import World
from mambaloc.uncertainty import UncertaintyHead, pooled

OPSET = 18
_CHECKED_BATCHES = (1, 3)
_TOLERANCE = 0.01  # of a radius, over itself


@dataclass(frozen=True)
class Parity:
    """Largest difference between ONNX Runtime and PyTorch.

    Args:
        position_m: of positions.
        rotation_deg: of rotations.
        max_norm_m: largest distance from the scene's origin in PyTorch's output; float32 rounds in proportion to it.
        uncertainty: of radii and unfamiliarity, over PyTorch's; 0 for a model without them.
        scene: of scenes' probabilities; 0 for a model that knows one.
    """

    position_m: float
    rotation_deg: float
    max_norm_m: float
    uncertainty: float = 0.0
    scene: float = 0.0

    @property
    @deprecated("Parity.reach_m is now max_norm_m. The old name is removed in the next release.")
    def reach_m(self) -> float:
        """Largest distance from the origin. Deprecated: removed in the next release."""
        return self.max_norm_m


class DeployedNetwork(nn.Module):
    """The network as an app sees it: plain tensors out, the quaternion canonical.

    Args:
        network: of the system.
        uncertainty: estimates each pose's uncertainty; None for a model without it.

    Shape:
        (B, 3, H, W) in 0..1, and for a network that takes them intrinsics (B, 3, 3) in its pixels -> (B, 3) in metres
        and (B, 4) unit wxyz with ``w >= 0``; with ``uncertainty`` three of (B,) follow, those of
        :class:`~mambaloc.uncertainty.UncertaintyHead`; of a network that knows S scenes their probabilities, (B, S).
    """

    def __init__(self, network: PoseNetwork, uncertainty: UncertaintyHead | None = None) -> None:
        super().__init__()
        self.network, self.uncertainty = network, uncertainty

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> tuple[Tensor, ...]:
        """Localize images."""
        feats = self.network.forward_backbone(image)
        prediction = self.network.forward_head(self.network.features(feats), intrinsics)
        outputs: tuple[Tensor, ...] = (prediction.position_m, canonical(prediction.quaternion))
        if self.uncertainty is not None:
            outputs += self.uncertainty(pooled(feats))
        if prediction.scene_logits is not None:
            outputs += (prediction.scene_logits.softmax(dim=-1),)
        return outputs


def export_onnx(
    system: LitPoseRegressor,
    path: Path,
    contract: Contract,
    uncertainty: UncertaintyHead | None = None,
    tolerance_m: float = 1e-3,
    tolerance_deg: float = 0.05,
) -> Parity:
    """Write a system's network as ONNX, with any batch size, and check it in ONNX Runtime.

    Args:
        system: trained; left as it was.
        path: the file; it appears only once it is complete and has passed.
        contract: metadata to write into the file; :func:`contract_of` makes it.
        uncertainty: for a model that estimates each pose's uncertainty.
        tolerance_m: largest position difference allowed, in metres per metre of the scene's size (at least one) or of
            the distance that the network says: noise may lead it far out of the scene.
        tolerance_deg: largest rotation difference allowed.

    Raises:
        InputError: where ONNX Runtime disagrees with PyTorch, or the file cannot be written.
    """
    deployed = DeployedNetwork(copy.deepcopy(system.network).cpu().float(), uncertainty).eval()
    with writing(path, "choose another folder"), atomic_file(path) as partial:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(deployed, contract, partial)
        parity = check_parity(deployed, partial, system.image_size)
        size_m = max(1.0, _largest_position_m(deployed), parity.max_norm_m)
        is_close = parity.position_m <= tolerance_m * size_m and parity.rotation_deg <= tolerance_deg
        if not (is_close and parity.uncertainty <= _TOLERANCE and parity.scene <= _TOLERANCE):
            raise InputError(
                f"{path}: ONNX Runtime differs from PyTorch by {parity.position_m:.2g} m, "
                f"{parity.rotation_deg:.2g} deg and {parity.uncertainty:.1%} of a radius, so it was not written; "
                "report the model and the versions"
            )
    return parity


def contract_of(
    system: LitPoseRegressor,
    data: Mapping[str, Any],
    uncertainty: UncertaintyHead | None = None,
    world: World | None = None,
    undistortion: Undistortion | None = None,
    scenes: Sequence[SceneFrame] = (),
) -> Contract:
    """Say what a system's exported network promises.

    Args:
        system: trained.
        data: hyperparameters of the data module that it was trained with.
        uncertainty: that the model will estimate.
        world: of the scene; without a shift unless given.
        undistortion: of the scene's images; with no lens known unless given.
        scenes: that the network knows, where there are several.
    """
    preprocessing = Preprocessing(data["short_side"], system.image_size)
    scene = ", ".join(each.name for each in scenes) or f"{data['dataset']}/{data['scene']}"
    weights, radii = weights_sha256(system.network), None if uncertainty is None else uncertainty.describe()
    intrinsics = None
    if system.network.takes_intrinsics:
        fx, _, cx, _, fy, cy, *_ = system.network.default_intrinsics.double().flatten().tolist()
        intrinsics = ((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0))
    return Contract(
        system.registry_name,
        scene,
        preprocessing,
        system.provenance,
        weights,
        radii,
        intrinsics,
        world=world or World(),
        undistortion=undistortion or Undistortion(),
        scenes=tuple(scenes),
    )


def contract_of_training(
    system: LitPoseRegressor,
    data: PoseDataModule | MultiSceneDataModule,
    uncertainty: UncertaintyHead | None = None,
) -> Contract:
    """Say what the exported network of a training promises, of one scene or of several.

    Args:
        system: trained.
        data: what it was trained with.
        uncertainty: that the model will estimate.
    """
    first, *others = data.each_scene()
    if not isinstance(data, MultiSceneDataModule):
        return contract_of(system, first.hparams, uncertainty, first.world, first.undistortion)
    scenes = [SceneFrame(name, world) for name, world in data.frames_of_reference]
    undistortion = first.undistortion if all(each.undistortion == first.undistortion for each in others) else None
    return contract_of(system, first.hparams, uncertainty, undistortion=undistortion, scenes=scenes)


def weights_sha256(network: nn.Module) -> str:
    """Digest of a network's parameters and buffers as float32, in the order of their names."""
    digest = hashlib.sha256()
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().float().contiguous().numpy().tobytes())
    return digest.hexdigest()


def check_parity(deployed: DeployedNetwork, path: Path, image_size: tuple[int, int], seed: int = 0) -> Parity:
    """Compare a file with the network it came from, on random images of several cameras in several batch sizes."""
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    generator = torch.Generator().manual_seed(seed)
    position_m, rotation_deg, max_norm_m, uncertainty, scene = [], [], [], [torch.zeros(())], [torch.zeros(())]
    for batch in _CHECKED_BATCHES:
        inputs = _random_inputs(deployed.network, batch, image_size, generator)
        with torch.inference_mode():
            expected_m, expected_q, *expected = deployed(**inputs)
        outputs = session.run(None, {name: tensor.numpy() for name, tensor in inputs.items()})
        actual_m, actual_q, *actual = map(torch.from_numpy, outputs)
        position_m.append((actual_m - expected_m).norm(dim=-1).max())
        rotation_deg.append(rotation_error_deg(actual_q, expected_q).max())
        max_norm_m.append(expected_m.norm(dim=-1).max())
        if deployed.network.scenes > 1:
            scene.append((actual.pop() - expected.pop()).abs().max())
        uncertainty += [((a - e).abs() / e.clamp_min(1e-6)).max() for a, e in zip(actual, expected, strict=True)]
    differences = (position_m, rotation_deg, max_norm_m, uncertainty, scene)
    return Parity(*(torch.stack(each).max().item() for each in differences))  # NaN stays NaN


def _random_inputs(
    network: PoseNetwork, batch: int, image_size: tuple[int, int], generator: torch.Generator
) -> dict[str, Tensor]:
    """Images, and for a network that takes intrinsics cameras from 0.8 to 1.25 times the usual focal length."""
    inputs = {IMAGE_INPUT: torch.rand(batch, 3, *image_size, generator=generator)}
    if network.takes_intrinsics:
        zoom = 0.8 * (1.25 / 0.8) ** torch.rand(batch, 1, 1, generator=generator)
        scaled = network.default_intrinsics * torch.tensor([1.0, 1.0, 0.0])
        inputs[INTRINSICS_INPUT] = network.default_intrinsics + (zoom - 1) * scaled
    return inputs


def _write(deployed: DeployedNetwork, contract: Contract, path: Path) -> None:
    inputs = _random_inputs(deployed.network, 2, contract.preprocessing.crop, torch.Generator().manual_seed(0))
    batch = Dim("batch")
    with _quiet():
        program = torch.onnx.export(
            deployed,
            tuple(inputs.values()),
            input_names=list(inputs),
            output_names=list(contract.outputs),
            dynamo=True,
            dynamic_shapes={name: {0: batch} for name in inputs},
            opset_version=OPSET,
            verbose=False,
        )
    assert program is not None
    program.model.metadata_props[METADATA_KEY] = contract.to_json()
    program.save(str(path), external_data=False)


@contextlib.contextmanager
def _quiet():  # type: ignore[no-untyped-def]
    """The exporter reports its steps on stdout and warns of its own internals."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _largest_position_m(deployed: nn.Module) -> float:
    scales = [m.scale_m + m.mean_m.norm(dim=-1) for m in deployed.modules() if isinstance(m, PositionScale)]
    return max((each.max().item() for each in scales), default=1.0)
