"""Backbones from timm, cut after the last layer used: feature maps, or one pooled feature."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import timm
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from timm.models import group_parameters
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from mambaloc.errors import InputError, suggestion
from mambaloc.nn.winograd import use_winograd


class ImageBackbone(nn.Module):
    """Base of backbones: a body that sees normalised images, and the weights it starts from.

    Args:
        name: what messages call the body.
        body: the module.
        weights: a ``.safetensors`` file, or None.
        pixel_mean: RGB mean in 0..1 that the body expects.
        pixel_std: RGB standard deviation in 0..1 to normalize with.

    Raises:
        InputError: for weights that are not there or do not fit.
    """

    body: Any
    pixel_mean: Tensor
    pixel_std: Tensor

    def __init__(
        self,
        name: str,
        body: nn.Module,
        weights: str | None,
        pixel_mean: tuple[float, float, float],
        pixel_std: tuple[float, float, float],
    ) -> None:
        super().__init__()
        self.name, self.body = name, body
        use_winograd(body)
        self._fixed: list[nn.Module] = []
        if weights is not None:
            self._load(Path(weights))
        self.register_buffer("pixel_mean", torch.tensor(pixel_mean).view(3, 1, 1))
        self.register_buffer("pixel_std", torch.tensor(pixel_std).view(3, 1, 1))
        self.to(memory_format=torch.channels_last)  # what fast convolution kernels read, on CPU and GPU

    @property
    def model(self) -> Any:
        """The module whose weights a file holds."""
        return self.body

    def normalized(self, image: Tensor) -> Tensor:
        """What the body sees of an image in 0..1."""
        return ((image - self.pixel_mean) / self.pixel_std).contiguous(memory_format=torch.channels_last)

    def train(self, mode: bool = True) -> Self:
        """Set the mode, but of what is frozen."""
        super().train(mode)
        for module in self._fixed:
            module.eval()
        return self

    def freeze(self, groups: int) -> None:
        """Keep the first layer groups, from the image on, as they are: weights, and batch-norm statistics.

        Raises:
            InputError: where the backbone has fewer groups.
        """
        if not hasattr(self.model, "group_matcher"):
            raise InputError(f"frozen_groups {groups}: {self.name} has no layer groups; set it to 0")
        names = group_parameters(self.model, self.model.group_matcher(coarse=True))
        if not 0 <= groups <= len(names):
            raise InputError(f"frozen_groups {groups}: {self.name} has {len(names)}; choose one of 0 to {len(names)}")
        for group in sorted(names)[:groups]:
            for name in names[group]:
                self.model.get_parameter(name).requires_grad_(False)
                self._fixed.append(self.model.get_submodule(name.rpartition(".")[0]).eval())

    def freeze_statistics(self) -> None:
        """Let every batch norm use, and keep, the statistics that it has."""
        self._fixed += [module.eval() for module in self.modules() if isinstance(module, _BatchNorm)]

    def _load(self, path: Path) -> None:
        if path.suffix != ".safetensors":
            raise InputError(f"backbone_weights {path}: only .safetensors files are read; convert it, or use 'timm'")
        try:
            missing, _ = self.model.load_state_dict(load_file(path), strict=False)
        except FileNotFoundError:
            raise InputError(f"backbone_weights {path}: no such file; name one, 'timm', or null") from None
        except (SafetensorError, RuntimeError, OSError) as error:
            reason = str(error).splitlines()[-1].strip()  # load_state_dict's first line names no tensor
            raise InputError(f"backbone_weights {path}: does not fit {self.name} ({reason})") from None
        if missing:
            raise InputError(
                f"backbone_weights {path}: {len(missing)} tensors of {self.name} are missing, such as {missing[0]}"
            )


class Backbone(ImageBackbone):
    """Feature maps of a timm model at given strides; stages past the last one do not exist.

    Args:
        name: any timm model with feature maps at ``strides``.
        strides: what each returned map's pixels span in the image.
        weights: ``timm`` downloads timm's own; otherwise a ``.safetensors`` file; None starts from scratch.
        timm_args: passed on to ``timm.create_model``, for instance ``{"pad_type": "same"}``.
        pixel_mean: RGB mean in 0..1; the timm model's own unless given.
        pixel_std: RGB deviation in 0..1; the timm model's own unless given.

    Shape:
        image (B, 3, H, W) in 0..1 -> one (B, channels[i], ~H / strides[i], ~W / strides[i]) a stride.

    Attributes:
        strides: of the maps, as they were asked for.
        channels: of the maps, in the same order.

    Raises:
        InputError: for an unknown model, strides that it does not have, or weights that do not fit.
    """

    def __init__(
        self,
        name: str,
        strides: tuple[int, ...] = (8, 16),
        weights: str | None = None,
        timm_args: dict[str, Any] | None = None,
        pixel_mean: tuple[float, float, float] | None = None,
        pixel_std: tuple[float, float, float] | None = None,
    ) -> None:
        cut = {"features_only": True, "feature_cls": "getter", "out_indices": _stages_at(name, strides)}
        body = _timm_model(name, weights, timm_args, **cut)
        config = body.model.pretrained_cfg
        file = None if weights == "timm" else weights
        super().__init__(name, body, file, pixel_mean or config["mean"], pixel_std or config["std"])
        self.strides = strides
        self.channels: list[int] = self.body.feature_info.channels()

    @property
    def model(self) -> Any:
        """The module whose weights a file holds."""
        return self.body.model

    def forward(self, image: Tensor) -> list[Tensor]:
        """Normalise the image and return its feature maps, finest first."""
        return self.body(self.normalized(image))

    @torch.no_grad()
    def grids(self, image_size: tuple[int, int]) -> list[tuple[int, int]]:
        """Rows and columns of each feature map for an image of ``(height, width)``, found by running one."""
        training = self.training
        try:
            return [tuple(feats.shape[-2:]) for feats in self.eval()(torch.zeros(1, 3, *image_size))]
        except (RuntimeError, AssertionError, ValueError) as error:
            raise InputError(f"image_size {image_size}: backbone {self.name!r} does not take it ({error})") from None
        finally:
            self.train(training)


class PooledBackbone(ImageBackbone):
    """A timm model without its classifier: one globally average-pooled feature per image.

    The arguments are those of :class:`Backbone`.

    Shape:
        image (B, 3, H, W) in 0..1 -> (B, width).

    Attributes:
        width: of the feature.

    Raises:
        InputError: for an unknown model or weights that do not fit.
    """

    def __init__(
        self,
        name: str,
        weights: str | None = None,
        timm_args: dict[str, Any] | None = None,
        pixel_mean: tuple[float, float, float] | None = None,
        pixel_std: tuple[float, float, float] | None = None,
    ) -> None:
        body = _timm_model(name, weights, timm_args, num_classes=0, global_pool="avg")
        config = body.pretrained_cfg
        file = None if weights == "timm" else weights
        super().__init__(name, body, file, pixel_mean or config["mean"], pixel_std or config["std"])
        self.width: int = body.head_hidden_size

    def forward(self, image: Tensor) -> Tensor:
        """Normalise the image and return its feature."""
        return self.body(self.normalized(image))


def _timm_model(name: str, weights: str | None, timm_args: dict[str, Any] | None, **cut: Any) -> Any:
    """Build a timm model, with errors a user can act on."""
    _check_known(name)
    try:
        return timm.create_model(name, pretrained=weights == "timm", **cut, **(timm_args or {}))
    except TypeError as error:
        raise InputError(f"backbone_args {timm_args}: {name} does not take them ({error})") from None
    except (OSError, RuntimeError) as error:
        if weights != "timm":
            raise InputError(f"backbone {name!r}: timm cannot build it with {timm_args} ({error})") from error
        raise InputError(
            f"model.backbone_weights: timm's weights of {name} could not be fetched ({type(error).__name__}). "
            "Connect to the Internet, name a local .safetensors file, or null to start from scratch."
        ) from error


def _check_known(name: str) -> None:
    if not timm.is_model(name):
        raise InputError(f"backbone {name!r}: timm has no such model. {suggestion(name, timm.list_models())}")


def _stages_at(name: str, strides: tuple[int, ...]) -> list[int]:
    """Index the deepest stage of a timm model at each stride."""
    if list(strides) != sorted(set(strides)):
        raise ValueError(f"strides rise, as the maps come finest first, not {strides}")
    _check_known(name)
    try:
        with torch.device("meta"):
            model: Any = timm.create_model(name, features_only=True, feature_cls="getter")
        info = model.feature_info
        reductions: dict[int, int] = dict(zip(info.out_indices, info.reduction(), strict=True))
    except (RuntimeError, AttributeError, NotImplementedError) as error:
        raise InputError(f"backbone {name!r}: timm offers no feature maps of it ({error})") from None
    offered = sorted(set(reductions.values()))
    if not set(strides) <= set(offered):
        raise InputError(f"backbone {name!r}: needs feature maps at strides {strides}, has {offered}")
    return [max(stage for stage, reduction in reductions.items() if reduction == stride) for stride in strides]
