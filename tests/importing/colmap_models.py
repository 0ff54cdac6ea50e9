"""The recording as a COLMAP model, written by pycolmap."""

from __future__ import annotations

import numpy as np
import pytest
from recorded import SIZE
from scipy.spatial.transform import Rotation

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, the extra [colmap], writes the models")

MODELS = {
    "SIMPLE_PINHOLE": [60.0, 33.0, 25.0],
    "PINHOLE": [60.0, 61.0, 33.0, 25.0],
    "SIMPLE_RADIAL": [60.0, 33.0, 25.0, -0.12],
    "RADIAL": [60.0, 33.0, 25.0, -0.12, 0.03],
    "OPENCV": [60.0, 61.0, 33.0, 25.0, -0.12, 0.03, 0.002, -0.003],
    "FULL_OPENCV": [60.0, 61.0, 33.0, 25.0, -0.12, 0.03, 0.002, -0.003, 0.01, 0.1, 0.02, -0.01],
    "OPENCV_FISHEYE": [60.0, 61.0, 33.0, 25.0, -0.02, 0.01, 0.003, -0.002],
    "SIMPLE_RADIAL_FISHEYE": [60.0, 33.0, 25.0, -0.02],
    "RADIAL_FISHEYE": [60.0, 33.0, 25.0, -0.02, 0.01],
    "FOV": [60.0, 61.0, 33.0, 25.0, 0.8],
    "THIN_PRISM_FISHEYE": [60.0, 61.0, 33.0, 25.0, -0.02, 0.01, 0.002, -0.003, 0.003, -0.002, 0.001, 0.002],
}
NAMES = [f"walk/{k}.jpg" for k in (0, 1, 2)] + [f"run/{k}.jpg" for k in (9, 10, 11)]


def write_model(recording, folder, binary=True, models=("SIMPLE_RADIAL",), names=NAMES, points=True):
    """The recording's cameras, image k taken with model k modulo their number, and an image that was not placed."""
    model = pycolmap.Reconstruction()
    for number, name in enumerate(models):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number + 1, model=name, width=SIZE[0], height=SIZE[1], params=MODELS[name])
        )
    for k, (name, pose) in enumerate(zip(names, recording.world_from_cam, strict=True)):
        inverse = np.linalg.inv(pose)
        turn = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        seen = pycolmap.Point2DList([pycolmap.Point2D(np.array([3.0, 4.0]))])
        image = pycolmap.Image(name=name, camera_id=1 + k % len(models), image_id=k + 1, points2D=seen)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(turn), inverse[:3, 3]))
    if points:
        track = pycolmap.Track()
        for k in range(2):
            track.add_element(k + 1, 0)
        model.add_point3D(np.array([1.0, 2.0, 3.0]), track, np.zeros(3, np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_binary if binary else model.write_text)(str(folder))
