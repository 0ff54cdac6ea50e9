"""Points of a sparse map over the images that show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mambaloc.images import Image, read_image
from mambaloc.mapping import PosedFrames
from mambaloc.runtime.maps import CameraPose, MapLocalizer, SparseMap
from mambaloc.viz.png import write_png

_MATCHED, _UNMATCHED, _LOST = "#7CFC00", "#dddddd", "#ff5a4d"
_PANEL_IN = 2.6
_FRAMES = 4


@dataclass(frozen=True)
class Seen:
    """An image with its keypoints.

    Shape:
        ``pixels`` (N, 2), in the image; ``is_matched`` (N,).

    Args:
        is_accepted: whether the map finds the image.
    """

    image: Image
    pixels: NDArray[np.float64]
    is_matched: NDArray[np.bool_]
    is_accepted: bool


def write_points(maps: dict[str, SparseMap], frames: PosedFrames, path: Path, title: str) -> None:
    """Localize a few frames, evenly spread, in one map or another, and draw which of their keypoints matched.

    Args:
        maps: by what to call each.
        frames: to draw.
        path: the PNG to write.
        title: heads the plot.
    """
    rows = np.unique(np.linspace(0, len(frames) - 1, _FRAMES).round().astype(int))
    images = [read_image(each) if isinstance(each := frames.images[row], Path) else each for row in rows]
    localizers = {name: MapLocalizer(sparse_map) for name, sparse_map in maps.items()}
    seen = {
        name: [look(localizer, image, frames.intrinsics[row]) for image, row in zip(images, rows, strict=True)]
        for name, localizer in localizers.items()
    }
    draw_matches(seen, path, title)


def look(localizer: MapLocalizer, image: Image, intrinsics: NDArray[np.float64]) -> Seen:
    """Localize an image, and keep which of its keypoints show a point of the map."""
    features = localizer.features(image, intrinsics)
    found = localizer.localize_features(features)
    is_matched = np.zeros(len(features), bool)
    if np.isfinite(found.position_m).all():
        pose = CameraPose.from_quaternion(found.quaternion, found.position_m)
        is_matched[localizer.matches(features, localizer.drift.to_adjusted(pose))[0]] = True
    scale = image.shape[1] / features.size[0]
    return Seen(image, (features.pixels + 0.5) * scale - 0.5, is_matched, found.is_accepted)


def draw_matches(rows: Mapping[str, Sequence[Seen]], path: Path, title: str) -> None:
    """Draw images with their keypoints: matched ones in green, others in grey.

    Args:
        rows: the same images seen in one map or another, by what to call it.
        path: the PNG to write.
        title: heads the plot.
    """
    columns = max(len(row) for row in rows.values())
    height, width = next(iter(rows.values()))[0].image.shape[:2]
    figure = Figure(
        figsize=(_PANEL_IN * columns + 0.4, (_PANEL_IN * height / width + 0.25) * len(rows) + 0.4), layout="constrained"
    )
    panels = figure.subplots(len(rows), columns, squeeze=False)
    for (name, row), axes in zip(rows.items(), panels, strict=True):
        axes[0].set_ylabel(name, fontsize=10)
        for seen, panel in zip(row, axes, strict=True):
            panel.imshow(seen.image)
            for chosen, color, size in ((~seen.is_matched, _UNMATCHED, 2), (seen.is_matched, _MATCHED, 7)):
                panel.scatter(*seen.pixels[chosen].T, s=size, color=color, linewidths=0)
            panel.set(xticks=[], yticks=[], xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
            verdict = "" if seen.is_accepted else ", lost"
            panel.set_title(f"{seen.is_matched.sum()} matches{verdict}", fontsize=9, pad=3)
            for spine in panel.spines.values():
                spine.set(color="#cccccc" if seen.is_accepted else _LOST, linewidth=0.8 if seen.is_accepted else 2.5)
    figure.suptitle(title, fontsize=11)
    write_png(figure, path)
