"""ONNX export, checked against PyTorch before the file is given its name."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import io
import logging
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnxruntime
import torch
from torch import Tensor, nn
from torch.export import Dim

from mambaloc.errors import InputError
from mambaloc.files import whole_file, writing
from mambaloc.geometry import canonical, rotation_error_deg
from mambaloc.models import LitPoseRegressor
from mambaloc.nn import PositionScale
from mambaloc.runtime.contract import METADATA_KEY, Contract, Preprocessing

OPSET = 18
_CHECKED_BATCHES = (1, 3)


@dataclass(frozen=True)
class Parity:
    """Largest difference between ONNX Runtime and PyTorch.

    Args:
        position_m: of positions.
        rotation_deg: of rotations.
        reach_m: largest distance from the scene's origin that PyTorch said; float32 rounds in proportion to it.
    """

    position_m: float
    rotation_deg: float
    reach_m: float


class DeployedNetwork(nn.Module):
    """The network as an app sees it: plain tensors out, the quaternion canonical.

    Shape:
        (B, 3, H, W) in 0..1 -> (B, 3) in metres and (B, 4) unit wxyz with ``w >= 0``.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Localise images."""
        prediction = self.network(image)
        return prediction.position_m, canonical(prediction.quaternion)


def export_onnx(
    system: LitPoseRegressor, path: Path, contract: Contract, tolerance_m: float = 1e-3, tolerance_deg: float = 0.05
) -> Parity:
    """Write a system's network as ONNX, with any batch size, and check it in ONNX Runtime.

    Args:
        system: trained; left as it was.
        path: the file; it appears only once it is complete and has passed.
        contract: what the file tells of itself; :func:`contract_of` makes it.
        tolerance_m: largest position difference allowed, in metres per metre of the scene's size (at least one) or of
            the distance that the network says: noise may lead it far out of the scene.
        tolerance_deg: largest rotation difference allowed.

    Raises:
        InputError: where ONNX Runtime disagrees with PyTorch, or the file cannot be written.
    """
    deployed = DeployedNetwork(copy.deepcopy(system.network).cpu().float()).eval()
    with writing(path, "choose another folder"), whole_file(path) as partial:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(deployed, contract, partial)
        parity = check_parity(deployed, partial, system.image_size)
        size_m = max(1.0, _largest_position_m(deployed), parity.reach_m)
        if not (parity.position_m <= tolerance_m * size_m and parity.rotation_deg <= tolerance_deg):
            raise InputError(
                f"{path}: ONNX Runtime differs from PyTorch by {parity.position_m:.2g} m and "
                f"{parity.rotation_deg:.2g} deg, so it was not written; report the model and the versions"
            )
    return parity


def contract_of(system: LitPoseRegressor, data: Mapping[str, Any]) -> Contract:
    """Say what a system's exported network promises.

    Args:
        system: trained.
        data: hyperparameters of the data module that it was trained with.
    """
    preprocessing = Preprocessing(data["short_side"], system.image_size)
    scene = f"{data['dataset']}/{data['scene']}"
    return Contract(system.registry_name, scene, preprocessing, system.provenance, weights_sha256(system.network))


def weights_sha256(network: nn.Module) -> str:
    """Digest of a network's parameters and buffers as float32, in the order of their names."""
    digest = hashlib.sha256()
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().float().contiguous().numpy().tobytes())
    return digest.hexdigest()


def check_parity(deployed: nn.Module, path: Path, image_size: tuple[int, int], seed: int = 0) -> Parity:
    """Compare a file with the network it came from, on random images in several batch sizes."""
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    generator = torch.Generator().manual_seed(seed)
    position_m, rotation_deg, reach_m = [], [], []
    for batch in _CHECKED_BATCHES:
        image = torch.rand(batch, 3, *image_size, generator=generator)
        with torch.inference_mode():
            expected_m, expected_q = deployed(image)
        actual_m, actual_q = (torch.from_numpy(a) for a in session.run(None, {"image": image.numpy()}))
        position_m.append((actual_m - expected_m).norm(dim=-1).max())
        rotation_deg.append(rotation_error_deg(actual_q, expected_q).max())
        reach_m.append(expected_m.norm(dim=-1).max())
    return Parity(*(torch.stack(each).max().item() for each in (position_m, rotation_deg, reach_m)))  # NaN stays NaN


def _write(deployed: nn.Module, contract: Contract, path: Path) -> None:
    image = torch.zeros(2, 3, *contract.preprocessing.crop)
    with _quiet():
        program = torch.onnx.export(
            deployed,
            (image,),
            input_names=["image"],
            output_names=["position_m", "quaternion_wxyz"],
            dynamo=True,
            dynamic_shapes={"image": {0: Dim("batch")}},
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
    scales = [m.scale_m.item() + m.mean_m.norm().item() for m in deployed.modules() if isinstance(m, PositionScale)]
    return max(scales, default=1.0)
