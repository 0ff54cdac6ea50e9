"""Depth of training frames, from a sensor or from the images: what views are made from.

Only frames that are trained on lend their depth: none of those held out, thinned away or tested on.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from mambaloc.data.depth_frames import NO_DEPTH_MM, depth_path, read_depth_intrinsics, read_depth_mm
from mambaloc.data.frame_dataset import CachedFrames
from mambaloc.data.frames import Frames
from mambaloc.data.points.depth import depth_rows
from mambaloc.errors import InputError
from mambaloc.memory import release_pages
from mambaloc.runtime.maps.viewpoints import farthest_points, spread_m, viewpoints
from mambaloc.runtime.rotations import matrix_from_quaternion, rigid_transforms
from mambaloc.synthesis import PosedDepth, carried_depth, depth_from_images, without_disagreeing
from mambaloc.synthesis.posed_depth import Floats

ViewDepth = Literal["auto", "sensor", "pictures"]
VIEW_DEPTHS: tuple[str, ...] = get_args(ViewDepth)

_MAX_FRAMES = 400  # with depth, spread over the poses; more cost time and add little
_ENOUGH_FRAMES = 20  # with depth; where there are fewer than twice as many frames, half of them
_FAR_OFF = 30.0  # times: no place of one scene, but another unit
_NAMED = 3  # files in a line
_SEARCHED = "Depth is searched in the images."


@dataclass(frozen=True)
class FoundDepth:
    """Frames with depth.

    Args:
        kind: ``sensor`` or ``pictures``.
        frames: that have depth.
        left_out: a line each on what could not be used.
    """

    kind: str
    frames: PosedDepth
    left_out: list[str] = field(default_factory=list)


def poses_of(frames: Frames) -> Floats:
    """``world_from_cam`` of frames, (N, 4, 4)."""
    return rigid_transforms(matrix_from_quaternion(frames.quaternion), frames.position_m)


def depth_of_frames(folder: Path, data: CachedFrames, how: ViewDepth, device: torch.device) -> FoundDepth:
    """Depth of training frames at the size that they are cached in.

    Args:
        folder: the scene's.
        data: the training frames.
        how: ``auto`` takes a sensor's where enough frames have some that fits the poses, else the images'.
        device: that searches depth in images.

    Raises:
        InputError: if no depth fits the poses.
    """
    rows = [] if how == "pictures" else depth_rows(data.frames)
    if how == "sensor":
        return from_sensor(folder, data, rows)
    lines = []
    if len(rows) >= min(_ENOUGH_FRAMES, -(-len(data.frames) // 2)):
        try:
            return from_sensor(folder, data, rows)
        except InputError as error:
            lines = [f"{error} {_SEARCHED}"]
    elif rows:
        lines = [f"{folder}: {len(rows)} of {len(data.frames)} training frames have depth, too few. {_SEARCHED}"]
    intrinsics = data.intrinsics.double().cpu().numpy()
    try:
        found = depth_from_images(data.images, intrinsics, poses_of(data.frames), device=device)
    except InputError as error:
        raise InputError(" ".join([*lines, str(error)])) from None
    return FoundDepth("pictures", found, lines)


def from_sensor(folder: Path, data: CachedFrames, rows: list[int]) -> FoundDepth:
    """Depth that a sensor measured beside training frames.

    Args:
        folder: the scene's.
        data: the training frames.
        rows: of those with depth.

    Raises:
        InputError: where no depth can be used, or most of it disagrees with the poses.
    """
    if not rows:
        raise InputError(f"{folder}: no training frame has depth. Set data.view_depth to pictures.")
    poses = poses_of(data.frames.select(np.array(rows)))
    chosen = np.array(rows)[farthest_points(viewpoints(poses, spread_m(poses)), _MAX_FRAMES, first=0)]
    files = [depth_path(data.frames.image_paths[row]) for row in chosen]
    intrinsics, poses = data.intrinsics[chosen].double().cpu().numpy(), poses_of(data.frames.select(chosen))
    read = read_all(folder, files, intrinsics, (data.images.shape[2], data.images.shape[3]))
    rules = {file: each for file, each in zip(files, read, strict=True) if isinstance(each, str)}
    if len(rules) == len(files):
        line = f"{files[0]}: depth {rules[files[0]]}, and no other depth frame can be used."
        raise InputError(f"{line} Repair them, or set data.view_depth to pictures.")
    known = {file: each for file, each in zip(files, read, strict=True) if not isinstance(each, str)}
    rules |= of_another_unit(known)
    kept = [row for row, file in enumerate(files) if file not in rules]
    depth_m = np.stack([known[files[row]] for row in kept])
    source = PosedDepth(data.images[chosen[kept]], depth_m, intrinsics[kept], poses[kept])
    release_pages(data.images)  # of all frames: those read ahead count, too
    source, off = without_disagreeing(source, [str(files[row]) for row in kept])
    return FoundDepth("sensor", source, lines_of({**rules, **{Path(f): "disagrees with the poses" for f in off}}))


def read_all(
    folder: Path, files: list[Path], intrinsics: Floats, size: tuple[int, int]
) -> list[NDArray[np.float32] | str]:
    """Depth frames carried into their images, of one size (height, width); or the rule that one breaks.

    Raises:
        InputError: for bad intrinsics of the sensor.
    """
    sensor_size = usual_size(files)
    sensor = read_depth_intrinsics(folder, sensor_size)

    def read(file: Path, matrix: Floats) -> NDArray[np.float32] | str:
        try:
            depth_mm = read_depth_mm(file)
        except InputError:
            return "is not a complete 16-bit PNG of one channel"
        if depth_mm.shape != sensor_size[::-1]:
            return f"is not {sensor_size[0]}x{sensor_size[1]} as most depth frames are"
        is_unknown = np.isin(depth_mm, NO_DEPTH_MM)
        if is_unknown.all():
            return "has no measured pixel"
        depth_m = carried_depth(np.where(is_unknown, np.nan, depth_mm / 1000), sensor, matrix, size)
        return depth_m if np.isfinite(depth_m).any() else "has no measured pixel in the image"

    with ThreadPoolExecutor() as pool:
        return list(pool.map(read, files, intrinsics))


def of_another_unit(known: Mapping[Path, NDArray[np.float32]]) -> dict[Path, str]:
    """Depth frames whose median is far from most others', and the rule that each breaks."""
    medians_m = {file: float(np.nanmedian(depth_m)) for file, depth_m in known.items()}
    usual_m = np.median([*medians_m.values()])
    return {
        file: f"is {median_m / usual_m:.2g} times that of most frames"
        for file, median_m in medians_m.items()
        if not 1 / _FAR_OFF < median_m / usual_m < _FAR_OFF
    }


def usual_size(files: Iterable[Path]) -> tuple[int, int]:
    """Width and height that most of some PNGs have, by their headers."""
    sizes: Counter[tuple[int, int]] = Counter()
    for file in files:
        with file.open("rb") as opened:
            head = opened.read(24)
        if len(head) == 24:
            sizes[struct.unpack(">II", head[16:])] += 1
    return sizes.most_common(1)[0][0] if sizes else (0, 0)


def lines_of(rules: Mapping[Path, str]) -> list[str]:
    """A line for each rule, which names the files that break it."""
    lines = []
    for rule in dict.fromkeys(rules.values()):
        files = [str(file) for file in rules if rules[file] == rule]
        more = f" and {len(files) - _NAMED} more" if len(files) > _NAMED else ""
        lines.append(f"{', '.join(files[:_NAMED])}{more}: depth {rule}. Views are made without it.")
    return lines
