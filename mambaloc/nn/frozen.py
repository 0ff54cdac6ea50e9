"""A backbone in two parts: its frozen layer groups, whose features can be kept, and the layers after them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection
from copy import copy
from typing import Any

import torch
from torch import Tensor, nn

from mambaloc.errors import InputError
from mambaloc.nn.backbone import ImageBackbone

_TOLERANCE = 1e-3  # of the features' largest value; the two parts run the same kernels


class SplitBackbone:
    """Runs the frozen layer groups of a backbone alone, and what comes after them alone; both share its modules.

    It is not an ``nn.Module``: no weight is listed twice. Each part is a shallow copy of the body, in which identities
    replace the modules of the other part.

    Args:
        backbone: some of whose first layer groups are frozen.
        image_size: (height, width) of an image, on which the two parts are compared with the whole.

    Raises:
        InputError: where no group is frozen, or the two parts do not give what the whole backbone gives.
    """

    def __init__(self, backbone: ImageBackbone, image_size: tuple[int, int]) -> None:
        self.backbone = backbone
        parts = _parts(backbone.model)
        frozen = [at for at, name in enumerate(parts) if _is_frozen(backbone.model.get_submodule(name))]
        if not frozen:
            raise InputError(f"model.frozen_groups 0: {backbone.name} has no frozen features to keep. Freeze some.")
        first, last = parts[: frozen[-1] + 1], parts[frozen[-1] + 1 :]
        self._first, self._last = (_with_model(backbone, _without(backbone.model, names)) for names in (last, first))
        self._find_frozen_maps(image_size)

    def frozen_state(self) -> dict[str, Tensor]:
        """Weights and statistics that the kept features depend on."""
        return dict(self._first.state_dict())

    @torch.no_grad()
    def frozen(self, image: Tensor) -> list[Tensor]:
        """Images, (B, 3, H, W) in 0..1, to the features that :meth:`trained` goes on from; a few (B, C, h, w)."""
        maps = _listed(self._first(self.backbone.normalized(image)))
        kept = [each for each, is_frozen in zip(maps, self._is_frozen, strict=True) if is_frozen]
        if all(self._is_frozen) or (kept and kept[-1] is maps[-1]):
            return kept
        return [*kept, maps[-1]]

    def trained(self, kept: list[Tensor]) -> Any:
        """What the backbone returns for the images that :meth:`frozen` gave these features of."""
        if all(self._is_frozen):
            return kept if self._is_list else kept[0]
        found = self._last(kept[-1].contiguous(memory_format=torch.channels_last))
        if not self._is_list:
            return found
        count = sum(self._is_frozen)  # the finest maps
        return [*kept[:count], *found[count:]]

    @torch.no_grad()
    def _find_frozen_maps(self, image_size: tuple[int, int]) -> None:
        """Find out which feature maps the frozen part gives, and compare the two parts with the whole."""
        backbone, training = self.backbone, self.backbone.training
        device = backbone.pixel_mean.device
        image = torch.rand(2, 3, *image_size, generator=torch.Generator().manual_seed(0)).to(device)
        backbone.eval()
        try:
            whole = backbone(image)
            self._is_list, maps = isinstance(whole, list), _listed(self._first(backbone.normalized(image)))
            self._is_frozen = [_agree(one, other) for one, other in zip(maps, _listed(whole), strict=True)]
            again = _listed(self.trained(self.frozen(image)))
            if not all(_agree(one, other) for one, other in zip(again, _listed(whole), strict=True)):
                raise RuntimeError("they give other features")
        except (RuntimeError, IndexError, ValueError) as error:
            raise InputError(
                f"model.feature_cache_gib: {backbone.name} cannot be split after its frozen groups ({error}). "
                "Set it to 0."
            ) from None
        finally:
            backbone.train(training)


def _parts(model: nn.Module, prefix: str = "") -> list[str]:
    """Names of modules in the order in which they run, each with frozen parameters alone or with none."""
    names = []
    for name, module in model.named_children():
        states = {parameter.requires_grad for parameter in module.parameters()}
        names += _parts(module, f"{prefix}{name}.") if len(states) == 2 else [f"{prefix}{name}"]
    return names


def _is_frozen(module: nn.Module) -> bool:
    return any(not parameter.requires_grad for parameter in module.parameters())


def _without(model: nn.Module, names: Collection[str]) -> nn.Module:
    """Shallow copy of a module in which some submodules pass their input on."""
    twin = copy(model)
    twin._modules = dict(model._modules)
    for child in {name.partition(".")[0] for name in names}:
        deeper = [name.partition(".")[2] for name in names if name.startswith(f"{child}.")]
        module = model.get_submodule(child)
        twin._modules[child] = _without(module, deeper) if deeper else _identity(module)
    return twin


def _identity(module: nn.Module) -> nn.Module:
    """What passes its input on in place of a module; models loop over a sequence, which stays one."""
    if isinstance(module, nn.Sequential):
        return nn.Sequential(OrderedDict((name, nn.Identity()) for name, _ in module.named_children()))
    return nn.Identity()


def _with_model(backbone: ImageBackbone, model: nn.Module) -> Any:
    """The backbone's body around another model: its feature maps are taken as before."""
    if backbone.model is backbone.body:
        return model
    body = copy(backbone.body)
    body._modules = {**backbone.body._modules, "model": model}
    return body


def _listed(feats: Any) -> list[Tensor]:
    return list(feats) if isinstance(feats, list | tuple) else [feats]


def _agree(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and bool((one - other).abs().max() <= _TOLERANCE * other.abs().max())
