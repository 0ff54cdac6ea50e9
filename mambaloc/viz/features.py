"""What the position branch makes of a frame: the principal components of its features as colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray
from torch import Tensor

from mambaloc.errors import InputError
from mambaloc.nn import PoseNetwork, TokenEncoder
from mambaloc.viz.heatmaps import readings
from mambaloc.viz.png import write_png

_CELL_IN, _COLORS = 2.2, 3
_PERCENTILES = (0.02, 0.98)


def position_features(network: PoseNetwork, image: Tensor) -> Tensor:
    """Return the position branch's final map of images, (B, C, rows, columns).

    Where the branch has a :class:`~mambaloc.nn.TokenEncoder` these are its cells after the last layer and the final
    norm; elsewhere it is the map that the branch reads, see :func:`~mambaloc.viz.heatmaps.readings`, whose arguments
    and errors these are.
    """
    feats_BCHW = readings(network, image)[0].feats
    encoder = getattr(network, "position_encoder", None)
    if not isinstance(encoder, TokenEncoder):
        return feats_BCHW
    with torch.no_grad():
        return encoder.cells(feats_BCHW)


def principal_components(feats_CHW: Tensor, count: int = _COLORS) -> Tensor:
    """Project a map's cells onto their first principal components, each of positive skew.

    A component's sign is arbitrary; this one makes the fewer cells that stand out the bright ones, in every system.

    Shape:
        (C, rows, columns) -> (count, rows, columns).

    Raises:
        InputError: for a map of too few cells or channels.
    """
    rows, columns = feats_CHW.shape[-2:]
    if min(rows * columns - 1, len(feats_CHW)) < count:
        raise InputError(
            f"a map of {len(feats_CHW)} channels and {rows} x {columns} cells has no {count} components; "
            "draw systems of larger images"
        )
    cells_NC = feats_CHW.flatten(1).T.double()
    left_NK, values_K, _ = torch.linalg.svd(cells_NC - cells_NC.mean(0), full_matrices=False)
    scores_NK = left_NK[:, :count] * values_K[:count]
    signs_K = torch.where(scores_NK.pow(3).sum(0) < 0, -1.0, 1.0)
    return (scores_NK * signs_K).T.unflatten(-1, (rows, columns)).to(feats_CHW.dtype)


def principal_colors(feats_CHW: Tensor, size: tuple[int, int]) -> Tensor:
    """Show a map's first three principal components as red, green and blue, (*size, 3) in 0..1.

    Each component's 2nd to 98th percentile spans its colour; between cells colours are interpolated.

    Args:
        feats_CHW: the map, (C, rows, columns).
        size: (height, width) in pixels.

    Raises:
        InputError: for a map of too few cells or channels.
    """
    components_KHW = principal_components(feats_CHW)
    low, high = components_KHW.flatten(1).quantile(torch.tensor(_PERCENTILES).to(feats_CHW), dim=1)[..., None, None]
    colors_KHW = (components_KHW - low) / (high - low).clamp_min(torch.finfo(feats_CHW.dtype).tiny)
    smooth = F.interpolate(colors_KHW.clamp(0, 1)[None], size, mode="bicubic")
    return smooth[0].clamp(0, 1).movedim(0, -1)


def draw_features(
    images: NDArray[Any], rows: Sequence[tuple[str, Sequence[NDArray[Any]]]], path: Path, title: str
) -> None:
    """Draw frames, and under each every system's features of it.

    Args:
        images: N frames, (N, H, W, 3) in 0..1.
        rows: each system's label, and :func:`principal_colors` of the N frames.
        path: the PNG to write.
        title: heads the figure.
    """
    count, height, width = images.shape[:3]
    size_in = (count * _CELL_IN + 0.5, (1 + len(rows)) * (_CELL_IN * height / width + 0.06) + 0.5)
    figure = Figure(figsize=size_in, layout=ConstrainedLayoutEngine(compress=True, w_pad=0.02, h_pad=0.02, hspace=0))
    cells = figure.subplots(1 + len(rows), count, squeeze=False)
    for line, (label, row_images) in enumerate((("", list(images)), *rows)):
        cells[line, 0].set_ylabel(label, fontsize=9)
        for axes, image in zip(cells[line], row_images, strict=True):
            axes.imshow(image, interpolation="bilinear")
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
    figure.suptitle(title, fontsize=11)
    write_png(figure, path)
