"""Scene points that views and frames show, from the depth that views are made from."""

from __future__ import annotations

import numpy as np

from mambaloc.data.frame_dataset import CachedFrames
from mambaloc.data.points.scene_points import Points, ScenePoints, frame_rng, stacked
from mambaloc.geometry import resized_intrinsics
from mambaloc.memory import release_pages
from mambaloc.synthesis import Splatter, Views
from mambaloc.synthesis.posed_depth import Floats

_STEP_PX = 2  # frames are rendered so much smaller; of their pixels a few hundred are drawn
_AT_ONCE = 64  # frames


def points_of_views(views: Views, count: int, seed: int) -> ScenePoints:
    """Draw pixels of each view and lift them by its depth into the world, at most ``count``."""
    points: list[Points] = []
    for row, (matrix, pose) in enumerate(zip(views.intrinsics, views.world_from_cam, strict=True)):
        points.append(_lifted(views.depth_m[row], matrix, pose, count, np.random.default_rng((seed, row))))
        if row % _AT_ONCE == 0:
            release_pages(views.depth_m)
    return ScenePoints(stacked(points, count), "views")


def points_of_frames_by_depth(
    splatter: Splatter, data: CachedFrames, world_from_cam: Floats, count: int, seed: int
) -> ScenePoints:
    """Draw points that frames see, from the depth of the nearest training frames, splatted into their cameras.

    Args:
        splatter: of training frames with depth.
        data: N frames, with depth of their own or without.
        world_from_cam: of these, (N, 4, 4).
        count: points a frame, at most.
        seed: of the draw.
    """
    height, width = data.images.shape[2:]
    size = (height // _STEP_PX, width // _STEP_PX)
    intrinsics = resized_intrinsics(data.intrinsics.double().cpu(), size[1] / width, size[0] / height).numpy()
    points: list[Points] = []
    for start in range(0, len(world_from_cam), _AT_ONCE):
        rows = range(start, min(start + _AT_ONCE, len(world_from_cam)))
        depth_m = splatter.render(world_from_cam[rows], intrinsics[rows], size).depth_m.cpu().numpy()
        points += [
            _lifted(each, intrinsics[row], world_from_cam[row], count, frame_rng(seed, data.frames.image_paths[row]))
            for each, row in zip(depth_m, rows, strict=True)
        ]
    return ScenePoints(stacked(points, count), "views")


def _lifted(
    depth_m: Floats, intrinsics: Floats, world_from_cam: Floats, count: int, rng: np.random.Generator
) -> Points:
    """World points (K, 3) of pixels drawn from those of an image (H, W) that have a depth."""
    known = np.flatnonzero(np.isfinite(depth_m))
    drawn = rng.choice(known, min(count, len(known)), replace=False, shuffle=False)
    y, x = np.divmod(drawn, depth_m.shape[1])
    rays = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(intrinsics).T
    points_cam_m = rays * depth_m.ravel()[drawn, None].astype(np.float64)
    return points_cam_m @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
