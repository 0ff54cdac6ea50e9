"""What speed is compared with: a training loop and a network as TransPoseNet's and AtLoc's programs have them.

The loop decodes every frame every epoch (PIL, torchvision transforms, loader workers), computes in float32, eagerly,
and reads each loss with ``.item()``. Others do less: RAP decodes once into memory, computes in float16 on a GPU,
compiles, and keeps batch-norm statistics. The network does what ours does, in its published form: see
:class:`Published`.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import timm
import torch
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, RandomSampler
from torchvision import transforms

from mambaloc.data import PoseDataModule
from mambaloc.data.frames import Split
from mambaloc.errors import InputError
from mambaloc.models import LitPoseRegressor
from mambaloc.models.transposenet import LitTransPoseNet
from mambaloc.nn import GlobalInformationSelector
from mambaloc.nn.encoder import EncoderLayer
from mambaloc.types import PoseBatch, PosePrediction


class DecodedFrames(Dataset[tuple[Tensor, Tensor, Tensor]]):
    """A scene's training or test frames, each decoded and transformed whenever it is asked for.

    Args:
        data: the scene, set up.
        mean: RGB mean in 0..1 to normalise with.
        std: RGB deviation, likewise.
        part: ``train`` crops at random and jitters; ``val`` and ``test`` crop the centre.

    Shape:
        an item is an image, (3, H, W), normalised, a position and a quaternion.
    """

    def __init__(self, data: PoseDataModule, mean: list[float], std: list[float], part: Split = "train") -> None:
        frames = data.frames(part)
        self.paths: list[Path] = list(frames.image_paths)
        self.position_m = torch.from_numpy(frames.position_m).float()
        self.quaternion = torch.from_numpy(frames.quaternion).float()
        jitter = data.jitter
        augmenting = [
            transforms.RandomCrop(data.crop),
            transforms.ColorJitter(jitter.brightness, jitter.contrast, jitter.saturation),
        ]
        self.transform = transforms.Compose(
            [
                transforms.Resize(data.hparams["short_side"]),
                *(augmenting if part == "train" else [transforms.CenterCrop(data.crop)]),
                transforms.ToTensor(),
                transforms.Normalize(mean, std),
            ]
        )

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, row: int) -> tuple[Tensor, Tensor, Tensor]:
        return self.transform(Image.open(self.paths[row]).convert("RGB")), self.position_m[row], self.quaternion[row]


class Published(nn.Module):
    """A network of ours in its published form: the same function of the same weights, with more work.

    timm's ``features_only`` backbone runs its stages past the last feature map that is read. Encoders drop a tenth of
    the attention weights, as ``nn.MultiheadAttention`` does, which keeps them from fused attention, and compute their
    last layer for all tokens, of which one is read. GIS runs as a sequence of two through the general scan. Images and
    weights are channels first, and PyTorch draws the masks of dropout.

    Args:
        system: MambaLoc or TransPoseNet, whose network's weights are copied.

    Shape:
        images (B, 3, H, W), normalised -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(self, system: LitTransPoseNet) -> None:
        super().__init__()
        network: Any = deepcopy(system.network)
        self.backbone = _whole_backbone(system)
        self.encoders = nn.ModuleList((network.position_encoder, network.orientation_encoder))
        self.gis = nn.ModuleList((network.position_gis, network.orientation_gis))
        self.head = network.head
        layers: list[Any] = [module for module in self.modules() if isinstance(module, EncoderLayer)]
        for layer in layers:
            layer.attention_dropout = 0.1
            layer.mlp[2], layer.dropout = (nn.Dropout(ours.p) for ours in (layer.mlp[2], layer.dropout))

    def forward(self, image: Tensor) -> PosePrediction:
        """Localise images."""
        maps = self.backbone(image.contiguous(memory_format=torch.contiguous_format))
        stride8_BCHW, stride16_BCHW = maps[2:4]
        position_BD, orientation_BD = (
            _select(gis, _encode(encoder, feats))
            for gis, encoder, feats in zip(self.gis, self.encoders, (stride16_BCHW, stride8_BCHW), strict=True)
        )
        return self.head(position_BD, orientation_BD)


def _encode(encoder: Any, feats_BCHW: Tensor) -> Tensor:
    cells_BND = encoder.project(feats_BCHW).flatten(2).mT
    tokens_BND = torch.cat((encoder.token.expand(len(cells_BND), -1, -1), cells_BND), dim=1)
    for layer in encoder.layers:
        tokens_BND = layer(tokens_BND, encoder.positions())
    return encoder.norm(tokens_BND)[:, 0]


def _select(gis: Any, feats_BD: Tensor) -> Tensor:
    if not isinstance(gis, GlobalInformationSelector):
        return gis(feats_BD)
    return gis.mixer(torch.stack((feats_BD.flip(-1), feats_BD), dim=1))[:, 1]


def _whole_backbone(system: LitTransPoseNet) -> nn.Module:
    """All stages of the same timm model, with the weights of those that are read."""
    whole: Any = timm.create_model(
        system.hparams["backbone"], features_only=True, **(system.hparams["backbone_args"] or {})
    )
    used: Any = system.network.backbone
    unknown = whole.load_state_dict(used.model.state_dict(), strict=False).unexpected_keys
    assert not unknown, unknown
    return whole


class ReferenceLoop:
    """The published loop over a scene.

    Args:
        system: whose loss is trained.
        data: the scene, set up.
        network: normalised images to poses; ``system``'s own, which normalises by itself, if None.
        steps: of a call of :meth:`train`: no loader process decodes beyond them.
        device: where it runs.
        workers: loader processes.

    Raises:
        InputError: for a loss over clips or scene points, which its loader does not have.
    """

    def __init__(
        self,
        system: LitPoseRegressor,
        data: PoseDataModule,
        network: nn.Module | None,
        steps: int,
        device: torch.device,
        workers: int,
    ) -> None:
        if data.hparams["clip_length"] > 1 or data.hparams["points_per_frame"] > 0:
            raise InputError("speed: the reference loop knows no clips and no scene points; measure another system")
        backbone: Any = system.network.backbone
        scale = ([0.0] * 3, [1.0] * 3) if network is None else (backbone.pixel_mean, backbone.pixel_std)
        self.mean, self.std = (torch.as_tensor(values).flatten().tolist() for values in scale)
        self.network = (deepcopy(system.network) if network is None else network).to(device)
        self.loss, self.device, self.data, self.workers = deepcopy(system.loss).to(device), device, data, workers
        parameters = [*self.network.parameters(), *self.loss.parameters()]
        self.optimizer = torch.optim.Adam(parameters, lr=system.lr, eps=1e-10, weight_decay=system.weight_decay)
        batch_size = data.hparams["batch_size"]
        self.batches = self.loader("train", batch_size, steps * batch_size)

    def loader(self, part: Split, batch_size: int, images: int) -> DataLoader[Any]:
        """So many images of a part in batches, decoded by the loader's processes; those to train on at random."""
        frames = DecodedFrames(self.data, self.mean, self.std, part)
        chosen = RandomSampler(frames, num_samples=images) if part == "train" else range(images)
        return DataLoader(
            frames,
            batch_size=batch_size,
            sampler=chosen,
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
            pin_memory=self.device.type == "cuda",
        )

    def to_device(self, image: Tensor, position_m: Tensor, quaternion: Tensor) -> PoseBatch:
        """Send what a loader gave to the device."""
        image, position_m, quaternion = (tensor.to(self.device) for tensor in (image, position_m, quaternion))
        return PoseBatch(image, position_m, quaternion, index=torch.arange(len(image)))

    def train(self, mark: Callable[[str], None] = lambda part: None) -> list[float]:
        """Train; each step's loss as a number. ``mark`` is told of each part of a step when it ends."""
        self.network.train()
        losses = []
        for fetched in self.batches:
            batch = self.to_device(*fetched)
            mark("load")
            self.optimizer.zero_grad()
            prediction = self.network(batch.image)
            mark("forward")
            loss = self.loss(prediction, batch)
            for auxiliary in prediction.auxiliary:
                loss = loss + 0.3 * self.loss(auxiliary, batch)
            mark("loss")
            loss.backward()
            mark("backward")
            self.optimizer.step()
            losses.append(loss.item())
            mark("optimiser")
        return losses

    def evaluate(self, batches: DataLoader[Any]) -> int:
        """Localise images; how many there were."""
        self.network.eval()
        count = 0
        with torch.no_grad():
            for fetched in batches:
                count += len(self.network(self.to_device(*fetched).image).position_m.cpu())
        return count
