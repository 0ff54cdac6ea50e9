"""A sparse map in a bundle: whether it is of the bundle's scene, its description, and poses that a port must find."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mambaloc.data import PoseDataModule
from mambaloc.data.cameras import frame_intrinsics
from mambaloc.data.frames import Frames
from mambaloc.errors import InputError
from mambaloc.images import Image, read_image
from mambaloc.runtime.maps import MAP_FILE, MapLocalizer, SparseMap
from mambaloc.runtime.maps.acceptance import CALIBRATION, MAX_DEVIATION, MIN_PROBABILITY, RULE
from mambaloc.runtime.maps.radii import LEVEL
from mambaloc.runtime.maps.viewpoints import spread_m
from mambaloc.runtime.rotations import rotation_error_deg

_ALLOWED = {"position_mm": 10.0, "rotation_deg": 0.3}
"""Between two builds of OpenCV, whose keypoints differ by little."""
_CHECKED = 8  # training frames
_ELSEWHERE = (0.2, 20.0)  # of the key frames' spread, and degrees
_COVARIANCE = (
    "position x y z in metres, then rotation x y z in radians about the world's axes, R = exp(rotation) R_estimated"
)


def check_scene(path: Path, sparse_map: SparseMap, data: PoseDataModule) -> None:
    """Refuse a map that does not localize training frames where their poses are: it is of another scene or camera.

    Args:
        path: of the map, for messages.
        sparse_map: of the scene, supposedly.
        data: of the scene. Nothing is checked where it has no training split.

    Raises:
        InputError: where hardly any frame is localized, or most elsewhere; or the scene's cameras are unknown.
    """
    try:
        listed = data.listed_training_frames()
    except InputError:  # a test split alone can be exported too
        return
    frames = listed.select(np.array(listed.evenly_spread(_CHECKED)))
    localizer, found = MapLocalizer(sparse_map), 0
    max_distance_m = _ELSEWHERE[0] * spread_m(sparse_map.key_poses)
    for row, intrinsics in enumerate(scene_intrinsics(data, frames)):
        pose = localizer.localize(read_image(frames.image_paths[row]), intrinsics)
        near = np.linalg.norm(pose.position_m - frames.position_m[row]) <= max_distance_m
        turned_deg = rotation_error_deg(pose.quaternion, frames.quaternion[row])
        found += bool(pose.is_accepted and near and turned_deg <= _ELSEWHERE[1])
    if 2 * found < len(frames):
        raise InputError(
            f"{path}: is a map of {sparse_map.scene!r}, which localizes {found} of {len(frames)} training frames of "
            f"{data.hparams['scene']}. Give the map of this scene and camera, or leave it out with --no-map."
        )


def scene_intrinsics(data: PoseDataModule, frames: Frames) -> np.ndarray:
    """Pinhole matrices (N, 3, 3) of frames of a data module's scene, in pixels of each image."""
    return frame_intrinsics(data.hparams["dataset"], data.folder, frames)


def describe_map(sparse_map: SparseMap) -> dict[str, Any]:
    """What ``contract.json`` says of the map."""
    return {
        "file": MAP_FILE,
        "scene": sparse_map.scene,
        "keypoints": "sift",
        "size": list(sparse_map.size),
        "intrinsics": sparse_map.intrinsics.tolist(),
        "points": len(sparse_map),
        "key_frames": len(sparse_map.key_poses),
        "accepted": {
            "rule": RULE,
            "least_probability": MIN_PROBABILITY,
            "most_deviation": MAX_DEVIATION,
            "least_inliers": sparse_map.least_inliers,
            "calibrated_on": CALIBRATION,
        },
        "covariance": _COVARIANCE,
        "level": LEVEL,
        "allowed": _ALLOWED,
    }


def map_vector(localizer: MapLocalizer, image: Image, intrinsics: np.ndarray) -> dict[str, Any] | None:
    """The pose that the map finds of a frame; None where that is not accepted."""
    pose = localizer.localize(image, intrinsics)
    found = {
        "position_m": pose.position_m.tolist(),
        "quaternion_wxyz": pose.quaternion.tolist(),
        "inliers": pose.inliers,
    }
    return found if pose.is_accepted else None
