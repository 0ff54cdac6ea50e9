"""Measure view synthesis on the training frames of a scene in the layout of 7-Scenes, on one core: depth from images
against the sensor's, views at the poses of held-out frames, and views a second.

The rate counts CPU time, from opening the frames to files on disk. Give --out a new folder: views are made only once.

python tools/benchmarks/views.py [--root FOLDER] [--scene NAME] [--short_side N] [--map FILE] [--out FOLDER]
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from mambaloc import provenance
from mambaloc.console import OptionParser, configure_logging, exit_on_input_error
from mambaloc.data.depth_frames import NO_DEPTH_MM, depth_path, read_depth_intrinsics, read_depth_mm
from mambaloc.images import read_image, resized
from mambaloc.mapping import PosedFrames
from mambaloc.mapping.posed import read_frames
from mambaloc.mapping.recipe import MapRecipe
from mambaloc.runtime.maps import CameraPose, MapLocalizer, SparseMap
from mambaloc.synthesis import (
    PlaneSweep,
    PosedDepth,
    carried_depth,
    confirmed,
    depth_from_images,
    held_out_quality,
    make_views,
    without_disagreeing,
)
from mambaloc.synthesis.depth_from_images import enlarged, range_from_images, range_of_points, searched
from mambaloc.viz.views import draw_views

_VIEWS = 512


@exit_on_input_error
def main() -> None:
    """Measure a scene, print, and draw a contact sheet for each kind of depth."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    parser.add_argument("--root", default="../shared/data/7scenes_blocks")
    parser.add_argument("--scene", default="redkitchen")
    parser.add_argument("--short_side", type=int, default=108, help="of the images and the views, in pixels")
    parser.add_argument("--map", type=Path, help="of the training frames, whose adjusted poses and lens are used")
    parser.add_argument("--out", type=Path, default=Path("runs/views"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    print(provenance.machine())
    frames = read_frames(MapRecipe(args.scene, root=args.root), "train")
    sparse_map = SparseMap.load(args.map) if args.map else None
    posed = small(adjusted(frames, sparse_map) if sparse_map else frames, args.short_side)
    sensor, rows = with_sensor(posed, frames, Path(args.root) / args.scene)
    measure("sensor", sensor, posed, args.out)
    compare(posed, sensor, rows, None if sparse_map is None else sparse_map.points_m)
    began = time.process_time()
    found = depth_from_images(posed.images, posed.intrinsics, posed.world_from_cam)
    print(f"plane sweep of {len(found)} key frames: {time.process_time() - began:.0f} s")
    measure("plane sweep", found, posed, args.out)


def adjusted(frames: PosedFrames, sparse_map: SparseMap) -> PosedFrames:
    """Frames with the poses and the focal length of a map, as its images have them."""
    drift = MapLocalizer(sparse_map).drift
    poses = [drift.to_adjusted(CameraPose(pose[:3, :3], pose[:3, 3])).matrix for pose in frames.world_from_cam]
    scale = np.array([[sparse_map.lens.focal, 1, 1], [1, sparse_map.lens.focal, 1], [1, 1, 1]])
    return PosedFrames(frames.images, frames.intrinsics * scale, np.stack(poses))


def small(frames: PosedFrames, short_side: int) -> PosedDepth:
    """All frames, resized, without depth."""
    decoded = [read_image(image) for image in frames.images]  # type: ignore[arg-type]
    images = np.stack([resized(image, short_side).transpose(2, 0, 1) for image in decoded])
    scale = np.diag((images.shape[3] / decoded[0].shape[1], images.shape[2] / decoded[0].shape[0], 1))
    scale[:2, 2] = (scale[[0, 1], [0, 1]] - 1) / 2
    depth_m = np.full((len(images), *images.shape[2:]), np.nan, np.float32)
    return PosedDepth(images, depth_m, scale @ frames.intrinsics, frames.world_from_cam)


def with_sensor(posed: PosedDepth, frames: PosedFrames, folder: Path) -> tuple[PosedDepth, np.ndarray]:
    """Those of the frames that have depth which agrees with the poses, and which of all they are."""
    files = {row: depth_path(Path(image)) for row, image in enumerate(frames.images)}  # type: ignore[arg-type]
    rows = np.array([row for row, file in files.items() if file.is_file()])
    size = (posed.images.shape[2], posed.images.shape[3])
    for row in rows:
        depth_mm = read_depth_mm(files[row])
        depth_m = np.where(np.isin(depth_mm, NO_DEPTH_MM), np.nan, depth_mm / 1000)
        camera = read_depth_intrinsics(folder, depth_mm.shape[::-1])
        posed.depth_m[row] = carried_depth(depth_m, camera, posed.intrinsics[row], size)
    kept, off = without_disagreeing(posed.select(rows), [files[row].name for row in rows])
    print(f"sensor: {len(kept)} frames; left out: {off or 'none'}")
    return kept, rows[[files[row].name not in off for row in rows]]


def compare(posed: PosedDepth, sensor: PosedDepth, rows: np.ndarray, points_m: np.ndarray | None) -> None:
    """Print how plane sweep answers where the sensor measured."""
    images, intrinsics = searched(posed.images, posed.intrinsics)
    cameras, size = (intrinsics, posed.world_from_cam), posed.images.shape[2:]
    if points_m is None:
        range_m = range_from_images(images, *cameras)
    else:
        range_m = range_of_points(points_m, *cameras, images.shape[2:])
    print(f"searched between {range_m[0]:.2f} and {range_m[1]:.2f} m")
    began = time.process_time()
    found = replace(sensor, depth_m=enlarged(PlaneSweep(images, *cameras, range_m).depth_m(rows), size))
    seconds = (time.process_time() - began) / len(rows)
    for name, depth_m in (("all", found.depth_m), ("confirmed", confirmed(found).depth_m)):
        is_both = np.isfinite(depth_m) & np.isfinite(sensor.depth_m)
        off = np.abs(depth_m / sensor.depth_m - 1)[is_both]
        cover = is_both.sum() / np.isfinite(sensor.depth_m).sum()
        print(
            f"plane sweep, {name}: {(off < 0.05).mean():.3f} within 5 %, {(off < 0.1).mean():.3f} within 10 %, "
            f"cover {cover:.3f}; {seconds:.2f} s a frame"
        )


def measure(name: str, source: PosedDepth, posed: PosedDepth, folder: Path) -> None:
    """Make views, print their rate and quality, and draw them."""
    began = time.process_time()
    size = (source.images.shape[2], source.images.shape[3])
    views = make_views(source, posed.world_from_cam, source.intrinsics[0], size, _VIEWS, folder)
    seconds = time.process_time() - began
    quality = held_out_quality(source)
    print(f"{name}: {len(views) / seconds:.0f} kept views a second, where they are new; {quality.describe()}")
    draw_views(source, views, quality, folder / f"{name.replace(' ', '_')}.png", f"views from {name}")


if __name__ == "__main__":
    main()
