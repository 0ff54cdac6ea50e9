"""A VisualSFM model (NVM_V3) of rendered images: points of what they show, tracked wherever they are in view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from mambaloc.rendering.quads import Vectors
from mambaloc.rendering.scenes.shots import Frame
from mambaloc.runtime.rotations import quaternion_from_matrix

_POINTS = 4000  # in all: about as many in an image as a real model has
_DEPTH_TOLERANCE = 0.02  # of the depth; the nearest pixel's is compared, which on a slanting plane is another


def write_nvm(
    path: Path, shots: Sequence[Frame], depth_m: Mapping[str, NDArray[np.floating]], intrinsics: Vectors, seed: int
) -> None:
    """Write cameras and points as Cambridge Landmarks ships them, its images named ``.jpg``.

    A point is tracked in every image that it projects into at the depth rendered there; it needs two images.

    Args:
        path: the file.
        shots: the images.
        depth_m: what was rendered, (H, W) by the shot's image, 0 where there is nothing.
        intrinsics: (3, 3), with equal focal lengths and the principal point at the centre.
        seed: of the draw of points.
    """
    points_m = np.concatenate([_drawn(shot, depth_m[shot.image], intrinsics, seed, len(shots)) for shot in shots])
    tracks: list[list[str]] = [[] for _ in points_m]
    for number, shot in enumerate(shots):
        seen, pixels = _seen(points_m, shot, depth_m[shot.image], intrinsics)
        for feature, (point, (x, y)) in enumerate(zip(seen, pixels - intrinsics[:2, 2], strict=True)):
            tracks[point].append(f"{number} {feature} {x:.3f} {y:.3f}")
    tracked = [(point, track) for point, track in zip(points_m, tracks, strict=True) if len(track) > 1]
    with path.open("w", encoding="utf-8") as file:
        file.write(f"NVM_V3\n\n{len(shots)}\n")
        file.writelines(_camera_line(shot, intrinsics) for shot in shots)
        file.write(f"\n{len(tracked)}\n")
        for (x, y, z), track in tracked:
            file.write(f"{x:.6f} {y:.6f} {z:.6f} 128 128 128 {len(track)} {' '.join(track)}\n")
        file.write("\n0\n")


def _drawn(shot: Frame, depth_m: NDArray[np.floating], intrinsics: Vectors, seed: int, shots: int) -> Vectors:
    """One image's share of the points: where some of its pixels are in the world, (K, 3)."""
    rng = np.random.default_rng([seed, *shot.image.encode()])
    filled = np.flatnonzero(depth_m)
    y, x = np.divmod(rng.choice(filled, min(len(filled), -(-_POINTS // shots)), replace=False), depth_m.shape[1])
    rays = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(intrinsics).T
    points_cam = rays * depth_m[y, x, None].astype(float)
    return points_cam @ shot.world_from_cam[:3, :3].T + shot.world_from_cam[:3, 3]


def _seen(
    points_m: Vectors, shot: Frame, depth_m: NDArray[np.floating], intrinsics: Vectors
) -> tuple[NDArray[np.int64], Vectors]:
    """Which points an image shows, (K,), and at which pixels, (K, 2)."""
    points_cam = (points_m - shot.world_from_cam[:3, 3]) @ shot.world_from_cam[:3, :3]
    ahead = np.flatnonzero(points_cam[:, 2] > 0)
    homogeneous = points_cam[ahead] @ intrinsics.T
    pixels = homogeneous[:, :2] / homogeneous[:, 2:]
    inside = ((pixels > -0.5) & (pixels < np.array(depth_m.shape[::-1]) - 0.5)).all(axis=1)
    ahead, pixels, z = ahead[inside], pixels[inside], homogeneous[inside, 2]
    x, y = np.round(pixels).astype(int).T
    agrees = np.abs(depth_m[y, x] - z) <= _DEPTH_TOLERANCE * z
    return ahead[agrees], pixels[agrees]


def _camera_line(shot: Frame, intrinsics: Vectors) -> str:
    cam_from_world = quaternion_from_matrix(shot.world_from_cam[:3, :3].T)
    numbers = [intrinsics[0, 0], *cam_from_world, *shot.world_from_cam[:3, 3]]
    return f"{PurePosixPath(shot.image).with_suffix('.jpg')}\t{' '.join(f'{number:.9f}' for number in numbers)} 0 0\n"
