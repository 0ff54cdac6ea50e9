"""The paper's figures: which systems are run on which frames, and where the images go."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.evaluation.curves import draw_cumulative, draw_sparsity, draw_time
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.evaluation.trained import Trained
from mambaloc.files import writing
from mambaloc.geometry import position_error_m, rotation_error_deg
from mambaloc.types import PoseBatch
from mambaloc.viz.features import draw_features, position_features, principal_colors
from mambaloc.viz.heatmaps import BranchHeat, draw_heat_maps, heat_maps
from mambaloc.viz.scene_page import write_scene_page
from mambaloc.viz.top_view import draw_top_view
from mambaloc.viz.trajectory import draw_trajectory

MAX_FRAMES = 12
"""Frames side by side in one figure."""

_OUTDOORS = {"cambridge"}


def draw_figures(kind: str, trained: Sequence[Trained], out: Path, frames: int = 3) -> list[Path]:
    """Draw a kind of figure of trained systems.

    Args:
        kind: a key of :data:`FIGURES`.
        trained: the systems; all kinds but ``trajectory`` show them in one image, on the same frames.
        out: the folder to write to.
        frames: how many test frames, evenly spaced, ``heatmaps`` and ``features`` show.

    Returns:
        The files.

    Raises:
        InputError: for frames that are not there, systems that do not go into one figure, or a folder that cannot be
            written.
    """
    if not 1 <= frames <= MAX_FRAMES:
        raise InputError(f"--frames {frames}: must be 1 to {MAX_FRAMES}")
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)  # fails now rather than once all is computed
    return FIGURES[kind](trained, out, frames)


def _trajectory(trained: Sequence[Trained], out: Path, frames: int) -> list[Path]:
    """An image and a page a system, of every test frame."""
    written = []
    for number, each in enumerate(trained, start=1):
        table, test_frames = localize_test_frames(each.system, each.data), each.data.frames("test")
        stem = "trajectory" if len(trained) == 1 else f"trajectory_{number}"
        plot, page = out / f"{stem}.png", out / f"{stem}.html"
        title = f"{each.name}, {each.run}\n{_where(each.data)}"
        draw = draw_top_view if each.data.hparams["dataset"] in _OUTDOORS else draw_trajectory
        names = [f"{path.parent.name}/{path.name}" for path in test_frames.image_paths]
        with writing(out):
            draw(table, test_frames.sequences, plot, title)
            write_scene_page(table, test_frames.sequences, names, page, title)
        written += [plot, page]
    return written


def _heatmaps(trained: Sequence[Trained], out: Path, frames: int) -> list[Path]:
    """Grad-CAM of both branches, a row a system."""
    batch, rows = _same_frames(trained, frames), []
    for each in trained:
        with torch.no_grad():
            prediction = each.system(batch.image, batch.intrinsics)
        errors_m = position_error_m(prediction.position_m, batch.position_m)
        errors_deg = rotation_error_deg(prediction.quaternion, batch.quaternion)
        maps = heat_maps(each.system.network, batch.image, batch.intrinsics)
        rows.append(BranchHeat(_beside(each), *maps, errors_m, errors_deg))
    path = out / "heatmaps.png"
    with writing(out):
        title = f"Where position and orientation look (Grad-CAM)\n{_where(trained[0].data)}"
        draw_heat_maps(_pixels(batch), rows, path, title)
    return [path]


def _features(trained: Sequence[Trained], out: Path, frames: int) -> list[Path]:
    """Principal components of the position branch's features, a row a system."""
    batch, rows = _same_frames(trained, frames), []
    for each in trained:
        feats_BCHW = position_features(each.system.network, batch.image)
        rows.append((_beside(each), [principal_colors(feats, each.data.crop).numpy() for feats in feats_BCHW]))
    path, title = out / "features.png", f"Principal components of the position branch\n{_where(trained[0].data)}"
    with writing(out):
        draw_features(_pixels(batch), rows, path, title)
    return [path]


def _curves(name: str, draw: Callable[[Sequence[Trained], Path, str], None]) -> Callable[..., list[Path]]:
    """A figure of curves, all systems on it."""

    def write(trained: Sequence[Trained], out: Path, frames: int) -> list[Path]:
        for each in trained:
            each.data.setup("test")
            _check_same_frames(each, trained[0])
        path = out / f"{name}.png"
        with writing(out):
            draw(trained, path, _where(trained[0].data))
        return [path]

    return write


FIGURES: dict[str, Callable[[Sequence[Trained], Path, int], list[Path]]] = {
    "trajectory": _trajectory,
    "heatmaps": _heatmaps,
    "features": _features,
    "cumulative": _curves("cumulative", draw_cumulative),
    "time": _curves("time", draw_time),
    "sparsity": _curves("sparsity", draw_sparsity),
}
"""Each kind of figure: it takes the systems, a folder that is there, and how many frames to show."""


def _same_frames(trained: Sequence[Trained], count: int) -> PoseBatch:
    """Evenly spaced test frames, cropped, that all the systems are to be looked at on."""
    first = trained[0]
    for each in trained:
        each.data.setup("test")
        if each.data.crop != first.data.crop:
            sizes = f"{each.data.crop}, but {first.checkpoint.path} {first.data.crop}"
            raise InputError(
                f"{each.checkpoint.path}: takes images of {sizes}; draw systems of one image size together"
            )
        _check_same_frames(each, first)
    total = len(first.data.frames("test"))
    if count > total:
        raise InputError(f"--frames {count}: there are {total} test frames; give at most so many")
    rows = ((np.arange(count) + 0.5) * total / count).astype(int).tolist()
    return next(first.data.batches("test", rows, size=count))


def _check_same_frames(trained: Trained, first: Trained) -> None:
    if _test_fingerprint(trained) != _test_fingerprint(first):
        raise InputError(
            f"{trained.checkpoint.path}: has other test frames than {first.checkpoint.path}; draw systems of one "
            "scene together, or set one with --data.scene"
        )


def _test_fingerprint(trained: Trained) -> str:
    return trained.data.describe()["fingerprints"]["test"]


def _pixels(batch: PoseBatch) -> np.ndarray:
    return batch.image.movedim(1, -1).numpy()


def _beside(trained: Trained) -> str:
    """A row's label, in short lines."""
    return f"{trained.name.replace(' ', chr(10), 1)}\n{trained.run}"


def _where(data: PoseDataModule) -> str:
    description = data.describe()
    split = "official split" if description["official_split"] else "not an official benchmark split"
    rendered = " (rendered)" if description["rendered"] else ""
    return f"{description['dataset']}/{description['scene']}, test{rendered}, {split}"
