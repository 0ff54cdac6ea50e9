"""Scene points from a COLMAP model in ``SCENE/sparse/0`` or ``SCENE/sparse``, text or binary.

Images are named by their path in the scene's folder, with whatever suffix. Of a distorted camera model the pinhole part
is taken: focal lengths and principal point, which COLMAP counts from the corner of the top-left pixel.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from mambaloc.data.frames import Frames
from mambaloc.data.points.reconstructions import Reconstruction, plain_name, points_of_frames, rows_by_name
from mambaloc.data.points.scene_points import ScenePoints
from mambaloc.errors import InputError
from mambaloc.geometry import quaternion_from_matrix, resized_intrinsics

COLMAP_FOLDERS = ("sparse/0", "sparse")

# A record of a binary file: so many bytes, a name that ends in 0 or none, a count, and so many bytes an item.
_RECORDS = {
    "images.bin": (64, True, "<Q", 24),
    "points3D.bin": (43, False, "<Q", 8),
    "frames.bin": (64, False, "<I", 16),
}


def colmap_folder(folder: Path) -> Path | None:
    """The folder of a scene's COLMAP model, if it has one."""
    for model in (folder / name for name in COLMAP_FOLDERS):
        if any((model / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
            return model
    return None


def read_colmap_points(folder: Path, frames: Frames, count: int, seed: int) -> ScenePoints:
    """Draw, of each frame, points that its image observes; the arguments of ``read_depth_points``.

    Raises:
        InputError: without pycolmap, or for a model that it cannot read, that holds none of the frames, or holds them
            in other poses.
    """
    path = colmap_folder(folder)
    if path is None:
        raise InputError(
            f"{folder / COLMAP_FOLDERS[0]}: holds no COLMAP model; put its cameras, images, points3D there"
        )
    rows = rows_by_name(folder, frames)
    model = _load(path)
    images = [image for image in model.images.values() if image.has_pose and plain_name(image.name) in rows]
    cameras = [model.cameras[image.camera_id] for image in images]
    if not all(_is_sound(camera) for camera in cameras):
        raise InputError(f"{path}: holds a camera without a size or a finite, positive focal length; export it again")
    size = (int(cameras[0].width), int(cameras[0].height)) if cameras else (1, 1)
    cam_from_world = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    known = Reconstruction(
        np.array([rows[plain_name(image.name)] for image in images], dtype=np.int64),
        np.array([image.projection_center() for image in images]).reshape(-1, 3),
        quaternion_from_matrix(torch.from_numpy(cam_from_world[:, :, :3].transpose(0, 2, 1).copy())).numpy(),
        np.array([_pinhole(camera, size) for camera in cameras]).reshape(-1, 3, 3),
        [_observed(model, image) for image in track(images, "Reading points", transient=True)],
    )
    return points_of_frames(known, path, frames, count, seed, size, "colmap")


def _load(path: Path) -> Any:
    try:
        import pycolmap
    except ImportError:
        raise InputError(f"{path}: is read by pycolmap, which is missing; pip install 'mambaloc[colmap]'") from None
    for name, record in _RECORDS.items():
        if (path / name).is_file() and not _is_whole((path / name).read_bytes(), *record):
            raise InputError(f"{path / name}: is cut off or counts more than it holds; export the model again")
    try:
        model = pycolmap.Reconstruction(path)
    except Exception as error:  # whatever COLMAP's C++ throws at a damaged file
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        message = f"{path}: is no COLMAP model that pycolmap can read ({reason[0][:200]}); export it again or remove it"
        raise InputError(message) from None
    cameras, read = path / "cameras.bin", 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if cameras.is_file() and cameras.stat().st_size < read:  # COLMAP fills up what is missing
        raise InputError(f"{cameras}: is cut off or counts more than it holds; export the model again")
    return model


def _is_whole(data: bytes, fixed: int, is_named: bool, count: str, item: int) -> bool:
    """Whether the file holds what it counts: COLMAP believes a count, and fills the memory."""
    try:
        (records,) = struct.unpack_from("<Q", data)
        at = 8
        for _ in range(records):
            at += fixed
            at = data.index(b"\0", at) + 1 if is_named else at
            (items,) = struct.unpack_from(count, data, at)
            at += struct.calcsize(count) + item * items
    except (struct.error, ValueError):
        return False
    return at <= len(data)


def _observed(model: Any, image: Any) -> NDArray[np.float64]:
    """The points that an image observes; ids without a point, as in a text that is cut off, are passed over."""
    ids = [point.point3D_id for point in image.get_observation_points2D()]
    points = [model.points3D[number].xyz for number in ids if model.exists_point3D(number)]
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def _is_sound(camera: Any) -> bool:
    sizes = (camera.width, camera.height, camera.focal_length_x, camera.focal_length_y)
    return bool(np.isfinite(camera.params).all()) and min(sizes) > 0


def _pinhole(camera: Any, size: tuple[int, int]) -> NDArray[np.float64]:
    """A camera's pinhole matrix in pixels of images of a size (width, height), (3, 3)."""
    focal, centre = (camera.focal_length_x, camera.focal_length_y), (camera.principal_point_x, camera.principal_point_y)
    matrix = np.array([[focal[0], 0, centre[0] - 0.5], [0, focal[1], centre[1] - 0.5], [0, 0, 1]])
    scale = (size[0] / camera.width, size[1] / camera.height)
    return resized_intrinsics(torch.from_numpy(matrix), *scale).numpy()
