"""Frames of a scene with their cameras, to build maps from and to measure these on."""

from __future__ import annotations

from pathlib import Path

from mambaloc.data.cameras import frame_intrinsics, undistortion_of
from mambaloc.data.datasets.capture import is_captured, world_of
from mambaloc.data.datasets.registry import DATASETS, locate, scene_folder
from mambaloc.data.frames import BadFrames, Frames, Split
from mambaloc.data.tracks import tracks_of_frames
from mambaloc.errors import InputError
from mambaloc.exif import head_of, unclear_pose
from mambaloc.mapping.building import PosedFrames
from mambaloc.mapping.recipe import MapRecipe
from mambaloc.runtime.rotations import matrix_from_quaternion, rigid_transforms


def read_frames(recipe: MapRecipe, split: Split) -> PosedFrames:
    """Read a split of a recipe's scene with its cameras.

    Raises:
        InputError: for a scene that cannot be read, or whose cameras are unknown.
    """
    dataset, root, scene = locate(recipe.dataset, recipe.root, recipe.scene)
    folder = scene_folder(dataset, Path(root) if root else None, scene)
    return with_cameras(dataset, folder, DATASETS[dataset].read_split(folder, split, BadFrames()))


def with_cameras(dataset: str, folder: Path, frames: Frames) -> PosedFrames:
    """Add the cameras to frames of a scene, and the points that it was imported with.

    Raises:
        InputError: where cameras are unknown, the points' file is damaged, or an EXIF orientation leaves open which
            pixels a pose means.
    """
    for path in frames.image_paths:
        if rule := unclear_pose(head_of(path)):
            raise InputError(f"{path}: {rule}")
    intrinsics = frame_intrinsics(dataset, folder, frames)
    poses = rigid_transforms(matrix_from_quaternion(frames.quaternion), frames.position_m)
    tracks = tracks_of_frames(folder, frames) if is_captured(folder) else None
    return PosedFrames(frames.image_paths, intrinsics, poses, tracks, world_of(folder), undistortion_of(folder))
