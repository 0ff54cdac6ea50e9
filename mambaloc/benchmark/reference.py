"""What speed is compared with: TransPoseNet's and AtLoc's programs, written from what their published code does.

The loop decodes each frame whenever it is asked for (PIL, torchvision transforms), computes in float32, eagerly, and
reads each loss with ``.item()``. Published programs differ in that: RAP's decodes once into memory, computes in float16
on a GPU, compiles, and keeps batch-norm statistics. The networks are the same functions of the same weights as ours.
"""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import timm
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, RandomSampler
from torchvision import transforms

from mambaloc.benchmark.clock import StepClock
from mambaloc.data import PoseDataModule
from mambaloc.data.frames import Split
from mambaloc.errors import InputError
from mambaloc.models import LitPoseRegressor
from mambaloc.models.atloc import LitAtLoc
from mambaloc.models.transposenet import LitTransPoseNet
from mambaloc.nn import GlobalInformationSelector
from mambaloc.nn.encoder import EncoderLayer
from mambaloc.types import PoseBatch, PosePrediction


class DecodedFrames(Dataset[tuple[Tensor, Tensor, Tensor]]):
    """A scene's training or test frames, each decoded and transformed whenever it is asked for.

    Args:
        data: the scene, set up.
        mean: RGB mean in 0..1 to normalise with.
        std: RGB standard deviation in 0..1 to normalize with.
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


class PublishedTransPoseNet(nn.Module):
    """TransPoseNet's network as its program has it; with GIS, MambaLoc's.

    The backbone runs its stages past the last feature map that is read. Encoders attend by ``nn.MultiheadAttention``,
    which returns its weights, and compute their last layer for all tokens, of which one is read. GIS runs as a sequence
    of two through the general scan. Images and weights are channels first. The program itself pads each convolution in
    an operation of its own, which this leaves out.

    Args:
        system: MambaLoc or TransPoseNet, whose network's weights are copied.

    Shape:
        images (B, 3, H, W), normalised -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(self, system: LitTransPoseNet) -> None:
        super().__init__()
        network: Any = deepcopy(system.network)
        self.backbone = _unpruned_backbone(system, features_only=True)
        encoders = (network.position_encoder, network.orientation_encoder)
        self.encoders = nn.ModuleList(PublishedEncoder(encoder) for encoder in encoders)
        self.gis = nn.ModuleList((network.position_gis, network.orientation_gis))
        self.head = network.head

    def forward(self, image: Tensor) -> PosePrediction:
        """Localize images."""
        stride8_BCHW, stride16_BCHW = self.backbone(image)[2:4]
        position_BD, orientation_BD = (
            _select(gis, encoder(feats))
            for gis, encoder, feats in zip(self.gis, self.encoders, (stride16_BCHW, stride8_BCHW), strict=True)
        )
        return self.head(position_BD, orientation_BD)


class PublishedEncoder(nn.Module):
    """An encoder of ours, whose weights it takes, in its published form; (B, C, H, W) -> (B, D)."""

    def __init__(self, encoder: Any) -> None:
        super().__init__()
        self.project, self.token, self.positions = encoder.project, encoder.token, encoder.positions
        self.layers = nn.ModuleList(PublishedLayer(layer) for layer in encoder.layers)
        self.norm = encoder.norm

    def forward(self, feats_BCHW: Tensor) -> Tensor:
        """Encode, and read the token."""
        cells_NBD = self.project(feats_BCHW).flatten(2).permute(2, 0, 1)
        tokens_NBD = torch.cat((self.token.repeat(1, len(feats_BCHW), 1), cells_NBD))
        positions_NBD = self.positions()[:, None].repeat(1, len(feats_BCHW), 1)
        for layer in self.layers:
            tokens_NBD = layer(tokens_NBD, positions_NBD)
        return self.norm(tokens_NBD)[0]


class PublishedLayer(nn.Module):
    """A layer of ours, whose weights it takes, in its published form; tokens (N, B, D) -> (N, B, D)."""

    def __init__(self, layer: EncoderLayer) -> None:
        super().__init__()
        dim, dropout = layer.v.in_features, layer.dropout.p
        self.attention = nn.MultiheadAttention(dim, layer.heads, dropout=layer.attention_dropout)
        self.attention.in_proj_weight = nn.Parameter(torch.cat((layer.qk.weight, layer.v.weight)).detach())
        self.attention.in_proj_bias = nn.Parameter(torch.cat((layer.qk.bias, layer.v.bias)).detach())
        self.attention.out_proj.load_state_dict(layer.out.state_dict())
        self.norm1, self.norm2 = layer.norm_attention, layer.norm_mlp
        self.linear1, self.linear2 = layer.mlp[0], layer.mlp[3]
        self.dropout, self.dropout1, self.dropout2 = (nn.Dropout(dropout) for _ in range(3))

    def forward(self, tokens_NBD: Tensor, positions_NBD: Tensor) -> Tensor:
        """Attend, then transform each token."""
        normed_NBD = self.norm1(tokens_NBD)
        placed_NBD = normed_NBD + positions_NBD
        tokens_NBD = tokens_NBD + self.dropout1(self.attention(placed_NBD, placed_NBD, normed_NBD)[0])
        hidden = self.dropout(F.gelu(self.linear1(self.norm2(tokens_NBD))))
        return tokens_NBD + self.dropout2(self.linear2(hidden))


class PublishedAtLoc(nn.Module):
    """AtLoc's network as its program has it: the backbone's classifier is the wide layer, images are channels first.

    Args:
        system: whose network's weights are copied.

    Shape:
        images (B, 3, H, W), normalised -> :class:`~mambaloc.types.PosePrediction`.
    """

    def __init__(self, system: LitAtLoc) -> None:
        super().__init__()
        network: Any = deepcopy(system.network)
        width = system.hparams["width"]
        self.backbone = _unpruned_backbone(system, num_classes=width)
        self.backbone.get_classifier().load_state_dict(network.fc[0].state_dict())
        self.attention, self.head, self.dropout = network.attention, network.head, network.dropout.p
        self.gis = nn.ModuleList((network.first_gis, network.second_gis))

    def forward(self, image: Tensor) -> PosePrediction:
        """Localize images."""
        feats_BD, attention = F.relu(self.backbone(image)), self.attention
        phi_BE1, theta_B1E = attention.phi(feats_BD).unsqueeze(2), attention.theta(feats_BD).unsqueeze(1)
        weights_BEE = F.softmax(torch.matmul(phi_BE1, theta_B1E), dim=-1)
        attended_BE = torch.matmul(weights_BEE, attention.g(feats_BD).unsqueeze(2)).squeeze(2)
        feats_BD = F.dropout(attention.out(attended_BE) + feats_BD, self.dropout, self.training)
        feats_BD = torch.cat(
            [_select(gis, half) for gis, half in zip(self.gis, feats_BD.chunk(2, -1), strict=True)], -1
        )
        return self.head(feats_BD, feats_BD)


def _select(gis: Any, feats_BD: Tensor) -> Tensor:
    if not isinstance(gis, GlobalInformationSelector):
        return gis(feats_BD)
    return gis.mixer(torch.stack((feats_BD.flip(-1), feats_BD), dim=1))[:, 1]


def _unpruned_backbone(system: LitPoseRegressor, **options: Any) -> Any:
    """All stages of the same timm model, with the weights of those that are read."""
    whole: Any = timm.create_model(system.hparams["backbone"], **options, **(system.hparams["backbone_args"] or {}))
    used: Any = system.network.backbone
    unknown = whole.load_state_dict(used.model.state_dict(), strict=False).unexpected_keys
    assert not unknown, unknown
    return whole


PUBLISHED: dict[type[LitPoseRegressor], Any] = {LitTransPoseNet: PublishedTransPoseNet, LitAtLoc: PublishedAtLoc}
"""Networks in their published form, by system; a subclass has its base's."""

PUBLISHED_DATA: dict[str, dict[str, int]] = {
    "transposenet": {"image_size": 224, "batch_size": 8},
    "atloc": {"image_size": 256, "batch_size": 64},
}
"""What the published programs train on, by system: pixels and images a step."""


def published_form(system: LitPoseRegressor) -> Any:
    """Return the class of a system's published network, or None without one here."""
    return next((network for ours, network in PUBLISHED.items() if isinstance(system, ours)), None)


def check_loaded(data: PoseDataModule) -> None:
    """Check whether the published loop can load what a scene's training batches hold.

    Raises:
        InputError: for clips and scene points, which it cannot.
    """
    if data.hparams["clip_length"] > 1 or data.hparams["points_per_frame"] > 0:
        raise InputError("speed: the published loop loads no clips and no scene points. Measure another system.")


class ReferenceLoop:
    """The published loop over a scene, with the published network.

    Args:
        system: whose function and loss are trained.
        data: the scene, set up.
        device: where it runs.
    """

    def __init__(self, system: LitPoseRegressor, data: PoseDataModule, device: torch.device) -> None:
        backbone: Any = system.network.backbone
        mean, std = (values.flatten().tolist() for values in (backbone.pixel_mean, backbone.pixel_std))
        self.frames, self.batch_size, self.device = DecodedFrames(data, mean, std), data.hparams["batch_size"], device
        self.network = published_form(system)(system).to(device)
        self.loss = deepcopy(system.loss).to(device)
        parameters = [*self.network.parameters(), *self.loss.parameters()]
        betas = (0.9, system.beta2)
        self.optimizer = torch.optim.Adam(
            parameters, lr=system.lr, betas=betas, eps=1e-10, weight_decay=system.weight_decay
        )

    def train(self, steps: int, clock: StepClock) -> list[float]:
        """Train so many steps; the loss of each as a number."""
        self.network.train()
        losses = []
        for fetched in self._batches(steps):
            image, position_m, quaternion = (tensor.to(self.device) for tensor in fetched)
            batch = PoseBatch(image, position_m, quaternion, index=torch.arange(len(image)))
            clock.mark("load")
            self.optimizer.zero_grad()
            prediction = self.network(batch.image)
            clock.mark("forward")
            loss = self.loss(prediction, batch)
            losses.append(loss.item())
            clock.mark("loss")
            loss.backward()
            clock.mark("backward")
            self.optimizer.step()
            clock.mark("optimiser")
            clock.end_step()
        return losses

    def _batches(self, steps: int) -> DataLoader[Any]:
        """Decoded by loader processes beside a GPU; on a CPU by this one, so that their seconds count."""
        on_gpu = self.device.type == "cuda"
        return DataLoader(
            self.frames,
            batch_size=self.batch_size,
            sampler=RandomSampler(self.frames, num_samples=steps * self.batch_size),
            num_workers=4 if on_gpu else 0,
            pin_memory=on_gpu,
        )
