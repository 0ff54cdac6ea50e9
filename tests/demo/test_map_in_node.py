"""The page's own modules find in a map what OpenCV and Python find."""

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mambaloc.images import read_image
from mambaloc.runtime.maps import MapLocalizer, SparseMap
from mambaloc.runtime.maps.absolute_pose import CameraPose, focal_scale, pose_covariance, refine_pose
from mambaloc.runtime.maps.acceptance import MAX_DEVIATION, MIN_PROBABILITY, Evidence, is_another_focal_length
from mambaloc.runtime.maps.drift import Drift, fit_drift
from mambaloc.runtime.maps.lens import Lens
from mambaloc.runtime.rotations import rotation_error_deg

pytestmark = pytest.mark.slow
HERE = Path(__file__).parent
WEB = resources.files("mambaloc.demo") / "web"


def pictures(den):
    """Images with their scale: as it is; smaller by 4 and by an odd share; RGBA; too many keypoints; hardly any."""
    room = read_image(sorted((den / "den/seq-02").glob("*.color.png"))[1])
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.normal(128, 60, (360, 480, 3)), None, 1.5)
    large = cv2.resize(room, (640, 480), interpolation=cv2.INTER_CUBIC)
    dim = np.full((60, 80, 3), 90, np.uint8) + (rng.random((60, 80, 1)) > 0.99).astype(np.uint8)
    with_alpha = np.dstack((large, np.full((480, 640), 255, np.uint8)))
    return [
        (room, 1.0), (large, 0.25), (large, 0.5), (with_alpha, 0.37), (room[:97, :131], 1.7),
        (np.clip(noise, 0, 255).astype(np.uint8), 1.0), (dim, 1.0), (room[:9, :9], 1.0),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def found(den, tmp_path_factory, node):
    """Each image's grey one, keypoints and descriptors, by OpenCV and by the page."""
    folder, cases, expected = tmp_path_factory.mktemp("features"), [], []
    sift = cv2.SIFT.create(1000, contrastThreshold=0.02, enable_precise_upscale=True)
    for number, (picture, scale) in enumerate(pictures(den)):
        height, width = picture.shape[:2]
        (folder / f"{number}.rgb").write_bytes(picture.tobytes())
        cases.append({"width": width, "height": height, "scale": scale})
        grey = cv2.cvtColor(np.ascontiguousarray(picture[..., :3]), cv2.COLOR_RGB2GRAY)
        size = (round(width * min(scale, 1)), round(height * min(scale, 1)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if size != (width, height) else grey
        keypoints, descriptors = sift.detectAndCompute(grey, None)
        expected.append((grey, np.array([point.pt for point in keypoints]).reshape(-1, 2), descriptors))
    (folder / "cases.json").write_text(json.dumps(cases))
    node(HERE / "features.mjs", WEB, folder)
    read = [[np.fromfile(folder / f"{number}.{kind}", dtype) for kind, dtype in _KINDS] for number in range(len(cases))]
    return list(zip(expected, read, strict=True))


_KINDS = (("grey", np.uint8), ("pixels", np.float64), ("descriptors", np.float32))


def test_grey_pictures_are_opencvs(found):
    for (grey, *_), (own, *_) in found:
        np.testing.assert_array_equal(own.reshape(grey.shape), grey)


def test_keypoints_are_opencvs(found):
    counts = []
    for (_, expected, descriptors), (_, pixels, own) in found:
        pixels, own = pixels.reshape(-1, 2), own.reshape(-1, 128)
        counts.append(len(expected))
        if not len(expected):
            assert not len(pixels)
            continue
        assert abs(len(pixels) - len(expected)) <= 0.01 * len(expected)
        for one, other in ((pixels, expected), (expected, pixels)):
            assert (cKDTree(one).query(other)[0] < 0.1).mean() > 0.98
        root = np.sqrt(descriptors / descriptors.sum(axis=1, keepdims=True))
        near = np.linalg.norm(expected[:, None] - pixels, axis=2) < 0.1  # one pixel may have several orientations
        apart = np.where(near, np.linalg.norm(root[:, None] - own, axis=2), 2).min(axis=1)
        assert np.quantile(apart, 0.95) < 0.05
        np.testing.assert_allclose(np.linalg.norm(own, axis=1), 1, atol=1e-6)
    assert counts[5] >= 1000 > counts[0] > 100
    assert counts[-1] == 0


EVIDENCE = [(0, 0.5, 3.0), (7, 0.03, 1.2), (16, 0.0004, 0.05), (12, 0.011, 0.4)]
"""Cells, deviations and turns."""


def random_problem(rng, count):
    """Points before a camera, and where it sees them in the plane at depth 1."""
    rotation = Rotation.random(random_state=rng).as_matrix()
    position_m = rng.normal(size=3)
    rays = rng.uniform(-0.6, 0.6, (count, 2))
    points = (np.hstack((rays, np.ones((count, 1)))) * rng.uniform(0.5, 6, (count, 1))) @ rotation.T + position_m
    return rotation, position_m, points, rays


def unit(rays):
    directions = np.hstack((rays, np.ones((len(rays), 1))))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def solved(node):
    """Problems whose poses are known, and what the page finds; of many points, a third are outliers."""
    rng = np.random.default_rng(1)
    threes = [random_problem(rng, 3) for _ in range(200)]
    manies = []
    for _ in range(20):
        rotation, position_m, points, rays = random_problem(rng, 90)
        seen = rays + rng.normal(0, 0.002, rays.shape)
        seen[:30] = rng.uniform(-0.6, 0.6, (30, 2))
        start = (
            rotation @ Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix(),
            position_m + rng.normal(0, 0.03, 3),
        )
        manies.append((rotation, position_m, points, seen, start))
    line = np.outer([1.0, 2.0, 3.0], [1.0, 0.5, 2.0])
    asked = {
        "three": [{"points": p.tolist(), "rays": unit(r).tolist()} for _, _, p, r in threes]
        + [{"points": line.tolist(), "rays": unit(np.array([[0, 0], [0.1, 0], [0, 0.1]])).tolist()}],
        "many": [
            {"points": p.tolist(), "rays": r.tolist(), "near": 0.02,
             "start": {"rotation": s[0].ravel().tolist(), "position_m": s[1].tolist()}}
            for _, _, p, r, s in manies
        ] + [{"points": p[:3].tolist(), "rays": r[:3].tolist(), "near": 0.02} for _, _, p, r, _ in manies[:1]],
        "evidence": EVIDENCE,
    }  # fmt: skip
    return threes, manies, json.loads(node(HERE / "poses.mjs", WEB, input=json.dumps(asked)))


def test_three_points_give_the_true_pose_among_at_most_four(solved):
    threes, _, answer = solved
    exact = 0
    for (rotation, position_m, points, rays), poses in zip(threes, answer["three"], strict=False):
        assert 1 <= len(poses) <= 4
        for pose in poses:
            cam = (points - pose["position_m"]) @ np.reshape(pose["rotation"], (3, 3))
            assert (cam[:, 2] > 0).all()
            np.testing.assert_allclose(cam[:, :2] / cam[:, 2:], rays, atol=1e-3)
            np.testing.assert_allclose(np.linalg.det(np.reshape(pose["rotation"], (3, 3))), 1, atol=1e-6)
        exact += any(
            np.allclose(pose["position_m"], position_m, atol=1e-3)
            and np.allclose(np.reshape(pose["rotation"], (3, 3)), rotation, atol=1e-3)
            for pose in poses
        )
    assert exact >= 0.98 * len(threes)  # a double root is inexact
    assert answer["three"][-1] == []  # points on a line


def test_ransac_finds_the_pose_among_outliers(solved):
    _, manies, answer = solved
    for (rotation, position_m, *_), found in zip(manies, answer["many"], strict=False):
        assert np.linalg.norm(np.array(found["ransac"]["position_m"]) - position_m) < 0.02
        turn = Rotation.from_matrix(np.reshape(found["ransac"]["rotation"], (3, 3)).T @ rotation)
        assert np.degrees(turn.magnitude()) < 0.3
    assert answer["many"][-1]["ransac"] is None  # of three matches


def test_refinement_is_pythons(solved):
    _, manies, answer = solved
    for (_, _, points, rays, start), found in zip(manies, answer["many"], strict=False):
        pose = refine_pose(CameraPose(*start), points, rays, 0.02)
        covariance = pose_covariance(pose, points, rays, 0.02)
        np.testing.assert_allclose(found["refined"]["pose"]["position_m"], pose.position_m, atol=1e-6)
        np.testing.assert_allclose(np.reshape(found["refined"]["pose"]["rotation"], (3, 3)), pose.rotation, atol=1e-6)
        np.testing.assert_allclose(found["refined"]["covariance"], covariance, rtol=1e-3, atol=1e-9)


def test_focal_lengths_and_probabilities_are_pythons(solved):
    _, manies, answer = solved
    for (_, _, points, rays, _), found in zip(manies, answer["many"], strict=False):
        refined = found["refined"]["pose"]
        pose = CameraPose(np.reshape(refined["rotation"], (3, 3)), np.array(refined["position_m"]))
        scale, deviation = focal_scale(pose, points, rays, 0.02)
        assert found["focal"]["scale"] == pytest.approx(scale, abs=1e-6)
        assert found["focal"]["deviation"] == pytest.approx(deviation, rel=1e-3)
        assert found["isAnother"] is is_another_focal_length(scale, deviation)
    for said, values in zip(answer["probabilities"], EVIDENCE, strict=True):
        assert said == pytest.approx(Evidence(*values).probability, abs=1e-12)
    assert (answer["least"], answer["most"]) == (MIN_PROBABILITY, MAX_DEVIATION)


def adjusted(path, folder):
    """The same map of a camera that is not quite a pinhole, whose given poses drifted by centimetres and degrees."""
    sparse_map = SparseMap.load(path)
    given, rng = sparse_map.key_poses.copy(), np.random.default_rng(2)
    given[:, :3, 3] += 0.05 * np.sin(given[:, :3, 3] + rng.normal(size=3))
    given[:, :3, :3] = Rotation.from_rotvec([0.0, 0.03, 0.01]).as_matrix() @ given[:, :3, :3]
    drift, nugget = fit_drift(sparse_map.key_poses, given)
    replace(sparse_map, lens=Lens(0.985, -0.04), drift=drift, nugget=nugget).save(folder / "adjusted.safetensors")
    return folder / "adjusted.safetensors"


@pytest.mark.parametrize("nugget", [1e-3, 1.0])
def test_drift_is_pythons(map_of_den, nugget, tmp_path, node):
    sparse_map = SparseMap.load(adjusted(map_of_den, tmp_path))
    poses = sparse_map.key_poses[::5].copy()
    poses[:, :3, 3] += 0.2
    told = [
        [{"rotation": pose[:3, :3].ravel().tolist(), "position_m": pose[:3, 3].tolist()} for pose in each]
        for each in (sparse_map.key_poses, poses)
    ]
    asked = {"keyPoses": told[0], "weights": sparse_map.drift.tolist(), "nugget": nugget, "poses": told[1]}
    drift = Drift(sparse_map.key_poses, sparse_map.drift, nugget)
    for matrix, found in zip(poses, json.loads(node(HERE / "drift.mjs", WEB, input=json.dumps(asked))), strict=True):
        pose = CameraPose(matrix[:3, :3], matrix[:3, 3])
        given, unsure = drift.to_given(pose)
        assert np.linalg.norm(given.position_m - pose.position_m) > 0.01
        for expected, own in ((given, found["given"]["pose"]), (drift.to_adjusted(pose), found["adjusted"])):
            np.testing.assert_allclose(own["position_m"], expected.position_m, atol=1e-9)
            np.testing.assert_allclose(np.reshape(own["rotation"], (3, 3)), expected.rotation, atol=1e-9)
        np.testing.assert_allclose(found["given"]["unsure"], unsure, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("is_adjusted", [False, True], ids=["as_it_is", "adjusted"])
def test_poses_in_a_map_are_pythons(den, map_of_den, is_adjusted, modules, tmp_path, node):
    map_of_den = adjusted(map_of_den, tmp_path) if is_adjusted else map_of_den
    frames = sorted((den / "den/seq-02").glob("*.color.png"))
    large, black = tmp_path / "large.png", tmp_path / "black.png"
    cv2.imwrite(str(large), cv2.resize(cv2.imread(str(frames[0])), (640, 480), interpolation=cv2.INTER_CUBIC))
    cv2.imwrite(str(black), np.zeros((120, 160, 3), np.uint8))
    answer = json.loads(node(HERE / "map_replay.mjs", modules, WEB, map_of_den, *frames, large, black))
    localizer = MapLocalizer(SparseMap.load(map_of_den))
    for path, found in zip([*frames, large], answer[:-1], strict=True):
        expected = localizer.localize(read_image(path))
        assert found["isAccepted"] is expected.is_accepted is True
        assert 1000 * np.linalg.norm(np.array(found["position_m"]) - expected.position_m) < 10
        assert rotation_error_deg(np.array(found["quaternion_wxyz"]), expected.quaternion) < 0.3
        assert abs(found["inliers"] - expected.inliers) <= 3
        assert found["probability"] == pytest.approx(expected.probability, abs=0.02)
        assert found["focalScale"] is expected.focal_scale is None
        deviation = [np.sqrt(np.trace(np.array(each)[:3, :3])) for each in (found["covariance"], expected.covariance)]
        assert deviation[0] == pytest.approx(deviation[1], rel=0.2)
        offs = np.array([match["off"] for match in found["matches"]])
        assert (offs <= 1).sum() == found["inliers"]
    assert answer[-1] is None
    assert not localizer.localize(read_image(black)).is_accepted
