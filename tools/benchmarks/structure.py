"""COLMAP's incremental and global mappers on rendered videos, and where an import spends its time.

python tools/benchmarks/structure.py [--seeds 5 6 7] [--frames 72]
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mambaloc.console import OptionParser, exit_on_input_error, whole_number
from mambaloc.importing.frame_choice import choose_frames
from mambaloc.importing.importer import import_scene
from mambaloc.importing.sfm.process import Job
from mambaloc.importing.sfm.reconstruction import find_features, match_features
from mambaloc.importing.sfm.structure import read_structure
from mambaloc.importing.video import write_frames
from mambaloc.rendering import default_intrinsics, furnished_room, render, smooth_trajectory
from mambaloc.runtime.sources import frames_of

Floats = NDArray[np.floating[Any]]

_SIZE = (320, 240)
_NEIGHBOURS = 10  # of a video's frame that it is matched with, as the import has them
_INSIDE_M = ((-1.25, -1.0, 1.1), (1.25, 1.0, 1.7))


@exit_on_input_error
def main() -> None:
    """Print CPU seconds of each step, and the errors of both mappers."""
    parser = OptionParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=whole_number(0), nargs="+", default=[5, 6, 7], help="a video each")
    parser.add_argument("--frames", type=whole_number(24), default=72, help="of a video")
    args = parser.parse_args()
    for seed in args.seeds:
        with TemporaryDirectory() as work:
            os.environ["MAMBALOC_CACHE"] = work  # where structure from motion is kept
            _measure(seed, args.frames, Path(work))


def _measure(seed: int, count: int, work: Path) -> None:
    video, world_from_cam = _video(seed, count, work)
    images, database = work / "images", work / "database.db"
    images.mkdir()
    chosen, taken_s = _timed(lambda: write_frames(choose_frames(frames_of(video)[0]), images))
    names = sorted(chosen[0])
    print(f"film {seed}: {len(names)} of {count} frames chosen, {taken_s:.2f} s")
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    job = asdict(Job(images, names, work, one_camera=True, neighbours=_NEIGHBOURS, threads=1, seed=0))
    for step in (find_features, match_features):
        _, taken_s = _timed(partial(step, pycolmap, {**job, "database": database}))
        print(f"  {step.__name__}: {taken_s:.2f} s")
    for mapper in (_incremental, _calibrated, _global):  # each changes its database
        own = work / mapper.__name__
        own.mkdir()
        shutil.copy(database, own / "database.db")
        model, taken_s = _timed(partial(mapper, own / "database.db", images, own))
        print(f"  {mapper.__name__[1:]}: {taken_s:.2f} s; {_describe(model, world_from_cam)}")
    _, taken_s = _timed(lambda: read_structure(video, threads=1))
    print(f"  all of it, as imported: {taken_s:.2f} s")
    print(f"  the rest of the import: {_timed(lambda: import_scene(video, work / 'scene'))[1]:.2f} s", flush=True)


def _video(seed: int, count: int, folder: Path) -> tuple[Path, Floats]:
    world_from_cam = smooth_trajectory(count, seed=seed, inside_m=_INSIDE_M, step_deg=1.5)
    room = furnished_room(_INSIDE_M, seed=0, px_per_m=140)
    path = folder / "room.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 15, _SIZE)
    for pose in world_from_cam:
        writer.write(render(room, default_intrinsics(_SIZE), pose, _SIZE)[0][..., ::-1])
    writer.release()
    return path, world_from_cam


def _incremental(database: Path, images: Path, out: Path) -> Any:
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0, extract_colors=False)
    return _largest(pycolmap.incremental_mapping(database, images, out, options))


def _global(database: Path, images: Path, out: Path) -> Any:
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=0)
    options.mapper.num_threads = 1
    options.mapper.random_seed = 0
    return _largest(pycolmap.global_mapping(database, images, out, options))


def _calibrated(database: Path, images: Path, out: Path) -> Any:
    pycolmap.calibrate_view_graph(database)  # a focal length, without which rotations of pairs are poor
    return _global(database, images, out)


def _largest(models: dict[int, Any]) -> Any:
    return max(models.values(), key=lambda model: model.num_reg_images())


def _describe(model: Any, world_from_cam: Floats) -> str:
    """Errors that are left when positions are laid over the true ones by a similarity."""
    placed = [image for image in model.images.values() if image.has_pose]
    true = world_from_cam[[int(Path(image.name).stem) for image in placed]]
    found = [image.cam_from_world().inverse() for image in placed]
    centers = np.array([pose.translation for pose in found])
    centered, true_centered = centers - centers.mean(axis=0), true[:, :3, 3] - true[:, :3, 3].mean(axis=0)
    rotation, _ = Rotation.align_vectors(true_centered, centered)
    turned = rotation.apply(centered)
    scale = (turned * true_centered).sum() / (turned**2).sum()
    error_mm = 1000 * np.linalg.norm(scale * turned - true_centered, axis=1)
    orientation = rotation * Rotation.from_quat(np.array([pose.rotation.quat for pose in found]))
    error_deg = np.degrees((orientation.inv() * Rotation.from_matrix(true[:, :3, :3])).magnitude())
    return (
        f"{len(placed)} placed, median {np.median(error_mm):.2f} mm, {np.median(error_deg):.2f} deg, "
        f"at most {error_mm.max():.2f} mm, {error_deg.max():.2f} deg; focal length {model.cameras[1].params[0]:.1f} px"
    )


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    started = os.times()
    found, ended = call(), os.times()
    return found, sum(ended[:4]) - sum(started[:4])  # of child processes, too: the import's COLMAP is one


if __name__ == "__main__":
    main()
