"""A map of pictures of two cameras, each with a matrix and a size of its own."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.mapping import MapSettings, PosedFrames, build_map
from mambaloc.rendering import default_intrinsics, embedded_room, embedded_walk, render, sensor
from mambaloc.runtime.localiser import Localiser
from mambaloc.runtime.maps import MAP_FILE, MapLocaliser

# The second is off centre, of pixels that are not square, and upright.
CAMERAS = [
    (default_intrinsics((160, 120)), (160, 120)),
    (np.array([[150.0, 0, 55.5], [0, 155.0, 84.5], [0, 0, 1]]), (120, 160)),
]


def film(count, seed):
    """Frames of both cameras in turns."""
    poses = embedded_walk(count, seed, start_deg=45.0 * seed, step_deg=360 / count)
    room, rng = embedded_room(), np.random.default_rng(seed)
    cameras = [CAMERAS[row % 2] for row in range(count)]
    shots = [render(room, matrix, pose, size)[0] for pose, (matrix, size) in zip(poses, cameras, strict=True)]
    return PosedFrames([sensor(shot, rng) for shot in shots], np.stack([matrix for matrix, _ in cameras]), poses)


@pytest.fixture(scope="module")
def room():
    return build_map(film(64, seed=1), MapSettings(key_frames=64, width=120), "room")


@pytest.fixture(scope="module")
def queries():
    return film(12, seed=2)


def errors(found, truth):
    turn = Rotation.from_matrix(truth[:3, :3]).inv() * Rotation.from_quat(found.quaternion, scalar_first=True)
    return np.linalg.norm(found.position_m - truth[:3, 3]), np.degrees(turn.magnitude())


def test_pictures_of_both_cameras_are_localised(room, queries, tmp_path):
    """In the map and in its file through the runtime; measured: medians of 0.014 m, 0.25 deg and 0.007 m, 0.14 deg."""
    assert room.size == (120, 90)
    assert room.lens.numbers == pytest.approx((1, 0), abs=1e-6)  # of several cameras none is fitted
    room.save(tmp_path / MAP_FILE)
    for localiser in (MapLocaliser(room), Localiser(tmp_path / MAP_FILE)):
        found = [localiser.localise(*each) for each in zip(queries.images, queries.intrinsics, strict=True)]
        off = np.array([errors(*each) for each in zip(found, queries.world_from_cam, strict=True)])
        assert all(each.is_accepted for each in found)
        for camera in range(2):
            print(np.median(off[camera::2], axis=0), off[camera::2].max(axis=0))
            assert (np.median(off[camera::2], axis=0) < (0.022, 0.4)).all()
            assert (off[camera::2].max(axis=0) < (0.05, 1.0)).all()


def test_the_other_cameras_matrix_is_seen_to_be_wrong(room, queries):
    """The focal length is a quarter too short."""
    localiser = MapLocaliser(room)
    wrong = CAMERAS[1][0] * [[0.75, 1, 1], [1, 0.75, 1], [1, 1, 1]]
    found = [localiser.localise(image, wrong) for image in queries.images[1::2]]
    assert not any(each.is_accepted for each in found)


def test_a_picture_of_another_shape_has_no_camera_by_default(room, queries):
    MapLocaliser(room).localise(queries.images[0])
    with pytest.raises(InputError, match=r"picture of 120x160: .*Give its intrinsics"):
        MapLocaliser(room).localise(queries.images[1])
