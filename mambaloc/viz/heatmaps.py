"""Where each branch looks: class-activation maps (Grad-CAM, Selvaraju et al. 2017) of the maps that branches read.

captum's LayerGradCam takes no layer that returns a list, as :class:`mambaloc.nn.Backbone` does, so the definition is
written out here; it is two lines.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from timm.layers import SelectAdaptivePool2d
from torch import Tensor, nn

from mambaloc.errors import InputError
from mambaloc.geometry import log_from_quaternion
from mambaloc.nn import Backbone, PoseNetwork
from mambaloc.viz.png import write_png

_CELL_IN = 1.6
_COLORS = "turbo"


class Reading(NamedTuple):
    """The map that a branch reads, and the gradient there of what the branch says; (B, C, rows, columns) both."""

    feats: Tensor
    gradient: Tensor


def readings(network: PoseNetwork, image: Tensor, intrinsics: Tensor | None = None) -> tuple[Reading, Reading]:
    """Return what the position branch and the orientation branch read of images.

    Of a backbone's maps a branch reads the deepest one that its answer depends on: in TransPoseNet stride 16 for the
    position and stride 8 for the orientation, elsewhere the same for both. Of a backbone that pools its map itself it
    is the map that enters the pooling.

    The gradient is of one number a branch, neither of which depends on the head's parametrisation. Position: the
    distance from the scene's mean, in units of its spread (the norm of what the head regresses). Orientation: the norm
    of the log-quaternion, half the angle by which the camera is turned from the world's axes; a quaternion's own norm
    would say nothing, since it is divided out.

    Args:
        network: in evaluation mode, where no frame sees another.
        image: (B, 3, H, W) in 0..1.
        intrinsics: (B, 3, 3) in pixels of it; the training camera's unless given.

    Raises:
        InputError: for a backbone without a map, such as a vision transformer.
    """
    with torch.enable_grad(), _listening(network.backbone) as maps:
        prediction = network(image.detach().requires_grad_(), intrinsics)
        answers = (
            network.head.position_scale.normalize(prediction.position_m),
            log_from_quaternion(prediction.quaternion),
        )
        position, orientation = (_reading(torch.linalg.vector_norm(answer, dim=-1), maps) for answer in answers)
    return position, orientation


def grad_cam(reading: Reading) -> Tensor:
    """Weigh a map's channels by their mean gradients and sum them; the magnitude, 0..1 in each frame.

    The original keeps positive values, which speak for its class. A pose has no class to speak against: what draws it
    nearer to the mean is as informative as what drives it away, and many a frame would have no positive value at all.

    Shape:
        (B, C, rows, columns) -> (B, rows, columns).
    """
    weights_BC11 = reading.gradient.mean((-2, -1), keepdim=True)
    cam_BHW = (weights_BC11 * reading.feats).sum(1).abs()
    return cam_BHW / cam_BHW.amax((-2, -1), keepdim=True).clamp_min(torch.finfo(cam_BHW.dtype).tiny)


def heat_maps(network: PoseNetwork, image: Tensor, intrinsics: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return the position and the orientation branch's heat maps of images, (B, rows, columns) in 0..1 each.

    The arguments and the errors are those of :func:`readings`.
    """
    position, orientation = readings(network, image, intrinsics)
    return grad_cam(position), grad_cam(orientation)


@dataclass(frozen=True)
class BranchHeat:
    """One system's row of the figure.

    Shape:
        ``position``, ``orientation`` (N, rows, columns) as :func:`heat_maps` returns them; errors (N,), of each frame.
    """

    label: str
    position: Tensor
    orientation: Tensor
    position_error_m: Tensor
    rotation_error_deg: Tensor


def draw_heat_maps(images: NDArray[Any], rows: Sequence[BranchHeat], path: Path, title: str) -> None:
    """Draw frames, and under each every system's maps of it, position left and orientation right.

    Args:
        images: N frames, (N, H, W, 3) in 0..1.
        rows: a row a system.
        path: the PNG to write.
        title: heads the figure.
    """
    count, height, width = images.shape[:3]
    cell_in = _CELL_IN * height / width
    figure = Figure(figsize=(2 * count * _CELL_IN + 1, (2 + len(rows)) * (cell_in + 0.25) + 0.6), layout="compressed")
    grid = figure.add_gridspec(1 + len(rows), 2 * count, height_ratios=(2, *[1] * len(rows)))
    for column, image in enumerate(images):
        _bare(figure.add_subplot(grid[0, 2 * column : 2 * column + 2])).imshow(image, interpolation="bilinear")
    for line, row in enumerate(rows, start=1):
        errors_m, errors_deg = row.position_error_m.tolist(), row.rotation_error_deg.tolist()
        for column, image in enumerate(images):
            axes = [_bare(figure.add_subplot(grid[line, 2 * column + side])) for side in (0, 1)]
            _overlay(axes[0], image, row.position[column])
            _overlay(axes[1], image, row.orientation[column])
            head = ("position\n", "orientation\n") if line == 1 else ("", "")
            axes[0].set_title(f"{head[0]}{errors_m[column]:.2f} m", fontsize=9)
            axes[1].set_title(f"{head[1]}{errors_deg[column]:.1f}°", fontsize=9)
            if column == 0:
                axes[0].set_ylabel(row.label, fontsize=9)
    heat = ScalarMappable(Normalize(0, 1), _COLORS)
    bar = figure.colorbar(heat, ax=figure.axes, location="right", fraction=0.02, pad=0.02, aspect=40, ticks=[0, 1])
    bar.set_label("heat, over each map's largest", fontsize=9)
    figure.suptitle(title, fontsize=11)
    write_png(figure, path)


def _bare(axes: Axes) -> Axes:
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    return axes


def _overlay(axes: Axes, image: NDArray[Any], heat_HW: Tensor) -> None:
    """Lay a map over its frame, in grey so that colour is heat alone."""
    smooth = F.interpolate(heat_HW[None, None], image.shape[:2], mode="bicubic").clamp(0, 1)[0, 0].cpu().numpy()
    axes.imshow(image.mean(-1), cmap="gray", vmin=0, vmax=1, interpolation="bilinear")
    axes.imshow(smooth, cmap=_COLORS, vmin=0, vmax=1, alpha=0.5)


@contextmanager
def _listening(backbone: nn.Module) -> Iterator[list[Tensor]]:
    """Give a list that the backbone's maps come into when it runs, finest first."""
    heard: list[Tensor] = []
    if isinstance(backbone, Backbone):
        handle = backbone.register_forward_hook(lambda _module, _image, maps: heard.extend(maps))
    else:
        handle = _pooling(backbone).register_forward_pre_hook(lambda _module, inputs: heard.append(inputs[0]))
    try:
        yield heard
    finally:
        handle.remove()


def _pooling(backbone: nn.Module) -> nn.Module:
    """The module of a pooled backbone that turns its map into a feature: timm's, or torchvision's own."""
    pools = [m for m in backbone.modules() if isinstance(m, SelectAdaptivePool2d | nn.AdaptiveAvgPool2d)]
    if not pools:
        raise InputError(
            f"backbone {getattr(backbone, 'name', backbone)!r}: has no spatial feature map, which Grad-CAM needs; "
            "choose a convolutional backbone"
        )
    return pools[-1]


def _reading(answer_B: Tensor, maps: Sequence[Tensor]) -> Reading:
    gradients = torch.autograd.grad(answer_B.sum(), maps, retain_graph=True, allow_unused=True)
    read = [(feats, gradient) for feats, gradient in zip(maps, gradients, strict=True) if gradient is not None]
    feats_BCHW, gradient_BCHW = read[-1]
    return Reading(feats_BCHW.detach(), gradient_BCHW)
