"""Images compared with poses and cameras that are right, and wrong in known ways."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import FLIP, SIZE, capture_of
from scipy.spatial.transform import Rotation

from mambaloc.importing.capture import Camera, Depth
from mambaloc.importing.checks.adjusting import adjust_poses
from mambaloc.importing.checks.agreement import Agreement, agreement, check_agreement
from mambaloc.importing.checks.depth import by_depth
from mambaloc.importing.checks.epipolar import FOCALS, agrees, best_focal, by_baseline, by_focal
from mambaloc.importing.checks.explanations import AS_READ, CONVENTIONS, better_order
from mambaloc.importing.checks.matching import Matches, find_matches
from mambaloc.importing.motion import motion_of
from mambaloc.importing.registry import read_capture
from mambaloc.importing.undistort.images import selected, write_images
from mambaloc.rendering import default_intrinsics, embedded_walk, render

REDKITCHEN = Path(__file__).parents[3].parent / "shared" / "data" / "7scenes_blocks" / "redkitchen"


@pytest.fixture(scope="module")
def written(rendered_once, tmp_path_factory):
    return write_images(read_capture(rendered_once.folder), tmp_path_factory.mktemp("written"))[0]


@pytest.fixture(scope="module")
def matches(written):
    return find_matches(written, motion_of(written))


@pytest.fixture(scope="module")
def filmed(room, tmp_path_factory):
    """Forty images of the room with exact poses, intrinsics and depth."""
    folder, poses, matrix = tmp_path_factory.mktemp("filmed"), embedded_walk(40, 5, 60.0, 3.0), default_intrinsics(SIZE)
    for row, pose in enumerate(poses):
        rgb, depth_m = render(room, matrix, pose, SIZE)
        cv2.imwrite(str(folder / f"{row}.png"), rgb[..., ::-1])
        cv2.imwrite(str(folder / f"{row}.depth.png"), np.rint(1000 * depth_m).astype(np.uint16))
    camera = Camera(*SIZE, (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))
    images, depth_files = (tuple(folder / f"{row}{end}" for row in range(40)) for end in (".png", ".depth.png"))
    return capture_of(
        poses, images=images, cameras={"c": camera}, camera_of=("c",) * 40, depth=Depth(depth_files, matrix)
    )


def checked(capture):
    """What is said of images and poses first, then of the rest."""
    return check_agreement(agreement(capture, motion_of(capture)))


# --- matches and lines -----------------------------------------------------------------------------------------------


def of_one_pair(first, second):
    """Matches of rows 0 and 1 in images of so long a focal length that a pixel is 1e-6."""
    rows = np.zeros(len(first), np.int64)
    return Matches(np.array([[0, 1]]), rows, first, second, np.array([1.5e6]), 1, False)


def test_matches_of_known_points_agree_and_others_do_not():
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = Rotation.from_euler("xyz", (3, 8, -2), degrees=True).as_matrix()
    poses[1, :3, 3] = (0.3, -0.1, 0.05)
    points = rng.uniform((-1, -1, 2), (1, 1, 5), (300, 3))
    seen = (points - poses[1, :3, 3]) @ poses[1, :3, :3]
    first, second = (each[:, :2] / each[:, 2:] for each in (points, seen))
    assert agrees(of_one_pair(first, second), poses).all()
    assert agrees(of_one_pair(first, rng.permutation(second)), poses).mean() < 0.05
    backwards = poses.copy()
    backwards[1, :3, 3] *= -1  # the same lines, and all points behind the cameras
    assert not agrees(of_one_pair(first, second), backwards).any()
    still = poses.copy()
    still[1, :3, 3] = 0  # draws no lines
    assert not agrees(of_one_pair(first, second), still).any()
    # The same images, whose camera is thought to be longer by a tenth.
    longer = of_one_pair(first / 1.1, second / 1.1)
    assert agrees(longer, poses).mean() < 0.05
    assert agrees(longer, poses, focal=1 / 1.1).all()


# --- poses -----------------------------------------------------------------------------------------------------------

MEANT = {
    AS_READ: lambda pose: pose,
    "world to camera": np.linalg.inv,
    "camera to world in OpenGL's axes": lambda pose: pose @ FLIP,
    "world to camera in OpenGL's axes": lambda pose: np.linalg.inv(pose @ FLIP),
    "camera to world with the quaternions' scalar first": lambda pose: reordered(pose, 1),
    "camera to world with the quaternions' scalar last": lambda pose: reordered(pose, -1),
    "world to camera with the quaternions' scalar first": lambda pose: np.linalg.inv(reordered(np.linalg.inv(pose), 1)),
    "world to camera with the quaternions' scalar last": lambda pose: np.linalg.inv(reordered(np.linalg.inv(pose), -1)),
}


def reordered(pose, places):
    """A pose whose quaternion, x y z w, is read with its numbers moved by so many places."""
    read = pose.copy()
    xyzw = Rotation.from_matrix(pose[:3, :3]).as_quat()
    read[:3, :3] = Rotation.from_quat(np.roll(xyzw, places)).as_matrix()
    return read


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_pictures_tell_in_which_convention_poses_are(written, convention):
    capture = replace(written, world_from_cam=np.stack([MEANT[convention](pose) for pose in written.world_from_cam]))
    found = agreement(capture, motion_of(capture))
    assert found.best == convention
    assert found.share[convention] > 0.6
    assert max(share for name, share in found.share.items() if name != convention) < 0.4
    concern = check_agreement(found)[0].concern
    assert (f"look like {convention}" in concern) == (convention != AS_READ)
    assert bool(concern) == (convention != AS_READ)
    is_format = convention == "world to camera"
    said = check_agreement(replace(found, kind="csv"))[0].concern
    assert ("import them with --format csv_cam_from_world" in said) == is_format
    assert ("convert them to camera to world in OpenCV's axes" in said) == (not is_format and convention != AS_READ)


def test_pictures_of_other_poses_agree_with_none(written):
    capture = replace(written, world_from_cam=np.roll(written.world_from_cam, 20, axis=0))
    assert "agree with the poses: these may be inaccurate" in checked(capture)[0].concern


@pytest.mark.parametrize(("shift", "says"), [(4, "the poses of 4 frames later"), (-1, "the poses of 1 frame earlier")])
def test_a_delay_is_found(written, shift, says):
    """Image k has the pose of frame k - shift."""
    rows = np.arange(20, 36) - 10
    capture = replace(selected(written, rows.tolist()), world_from_cam=written.world_from_cam[rows - shift])
    found = better_order(capture, find_matches(capture, motion_of(capture)))
    assert found.name == says
    assert found.share > 0.9 > found.as_read + 0.1
    assert f"the images fit {says} better" in checked(capture)[0].concern


def test_poses_in_reverse_are_found(written):
    capture = replace(written, world_from_cam=written.world_from_cam[::-1])
    assert "the images fit the poses in reverse better" in checked(capture)[0].concern


def test_pictures_sorted_as_text_are_found(written, tmp_path):
    """1.png to 40.png, whose poses are in the order 1, 10, 11, ..."""
    images = []
    for number, image in enumerate(written.images, start=1):
        images.append(tmp_path / f"{number}.png")
        images[-1].symlink_to(image)
    order = sorted(range(40), key=lambda row: images[row].name)
    capture = replace(written, images=tuple(images), world_from_cam=written.world_from_cam[np.argsort(order)])
    # Poses were written for images in the order of text, and are read for images in the order of numbers.
    capture = replace(capture, world_from_cam=written.world_from_cam[order])
    assert "the images fit the images sorted as text better" in checked(capture)[0].concern


def test_the_right_order_stays(written, matches):
    assert better_order(written, matches) is None
    findings = checked(written)
    assert not any(finding.concern for finding in findings)
    assert [finding.name for finding in findings] == ["images and poses", "focal length"]


def test_pictures_without_camera_are_compared_with_a_guess(written):
    findings = checked(replace(written, cameras={}, camera_of=None))
    assert "focal length guessed" in findings[0].message
    assert not any(finding.concern for finding in findings)


def test_poses_of_no_camera_are_a_concern_without_one(written):
    capture = replace(written, cameras={}, camera_of=None, world_from_cam=np.roll(written.world_from_cam, 20, axis=0))
    assert "no focal length makes more agree than chance" in checked(capture)[0].concern


def test_too_few_matches_are_no_evidence():
    few = Agreement(dict.fromkeys(CONVENTIONS, 0.0), 12, 3, [], np.zeros(len(FOCALS)), 100.0, False)
    (finding,) = check_agreement(few)
    assert finding.message == "not compared: 12 matches on 3 pairs of images"
    assert finding.concern.startswith("nothing could be compared: 12 matches")


def test_the_share_by_baseline(written, matches):
    """Every pair in one bin; exact poses agree with nearly all that could, drifting ones less the farther apart."""
    exact = by_baseline(matches, written.world_from_cam)
    assert [each.low for each in exact[1:]] == [each.high for each in exact[:-1]]
    assert sum(each.matches for each in exact) <= len(matches.pair)
    assert all(each.share > 0.85 * each.possible for each in exact)
    drifting = written.world_from_cam.copy()
    tilt = np.sin(np.linspace(0, 6, 40))[:, None]  # a drift about the upright axis would look like another lens
    drifting[:, :3, :3] = Rotation.from_euler("x", tilt, degrees=True).as_matrix() @ drifting[:, :3, :3]
    bins = by_baseline(matches, drifting, written.world_from_cam)
    assert bins[-1].share < 0.6 * bins[-1].possible
    assert [each.adjusted for each in bins] == pytest.approx([each.share for each in exact])
    assert "--adjust-poses writes poses" in checked(replace(written, world_from_cam=drifting))[0].concern


# --- the focal length ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("claimed", [1.0, 0.85, 1.2])
def test_the_focal_length_is_found(written, claimed):
    """The renderer's is known; the capture claims another."""
    ((name, camera),) = written.cameras.items()
    true_px = camera.focal_px[0]
    focal_px = (claimed * camera.focal_px[0], claimed * camera.focal_px[1])
    capture = replace(written, cameras={name: replace(camera, focal_px=focal_px)})
    found = agreement(capture, motion_of(capture))
    assert found.focal * found.focal_px == pytest.approx(true_px, rel=0.03)
    concerns = [finding.concern for finding in check_agreement(found) if finding.name == "focal length"]
    assert ("the focal length looks like" in concerns[0]) == (claimed != 1.0)


def test_the_peak_lies_between_the_focal_lengths_that_were_tried():
    peak = 1.043
    share = 0.8 - np.log(FOCALS / peak) ** 2
    assert best_focal(share) == pytest.approx(peak, rel=1e-4)


@pytest.mark.skipif(not REDKITCHEN.is_dir(), reason="needs ../shared/data/7scenes_blocks beside the repository")
def test_the_focal_length_of_real_frames_is_that_of_the_color_camera():
    """525 px at a width of 640, as data/cameras.py has it, not the depth sensor's 585; training frames alone.

    Takes ten seconds: 700 keypoints in each of 70 real images.
    """
    capture = read_capture(REDKITCHEN)
    capture = selected(capture, [row for row, split in enumerate(capture.split) if split == "train"])
    found = find_matches(capture, motion_of(capture))
    share = by_focal(found, capture.world_from_cam)
    assert best_focal(share) == pytest.approx(1, abs=0.03)
    assert share.max() > 1.3 * share[np.abs(FOCALS - 585 / 525).argmin()]
    depth = by_depth(capture, found)
    assert 0.96 <= depth.focal <= 1.01
    assert 0.96 <= depth.turn <= 1.0
    assert depth.focal_px.min() < 7


# --- depth -----------------------------------------------------------------------------------------------------------


def test_depth_says_that_all_is_right(filmed):
    found = by_depth(filmed, find_matches(filmed, motion_of(filmed)))
    assert found.focal == pytest.approx(1, abs=0.01)
    assert found.turn == pytest.approx(1, abs=0.01)
    assert found.given_px < 1
    assert "depth" in [finding.name for finding in checked(filmed) if not finding.concern]


def test_depth_finds_the_focal_length(filmed):
    """Depth is seen through the same wrong lens, as where a phone registers it."""
    camera = filmed.cameras["c"]
    wrong = replace(camera, focal_px=(1.1 * camera.focal_px[0], 1.1 * camera.focal_px[1]))
    matrix = filmed.depth.intrinsics @ np.diag((1.1, 1.1, 1.0))
    matrix[:2, 2] = filmed.depth.intrinsics[:2, 2]
    capture = replace(filmed, cameras={"c": wrong}, depth=replace(filmed.depth, intrinsics=matrix))
    found = by_depth(capture, find_matches(capture, motion_of(capture)))
    assert found.focal == pytest.approx(1 / 1.1, abs=0.015)
    concerns = {finding.name: finding.concern for finding in checked(capture)}
    assert "depth fits a focal length" in concerns["depth"]


def test_depth_finds_that_turns_are_too_large(filmed):
    """All turns from the first frame are 4 % too large, about the same centres."""
    poses = filmed.world_from_cam.copy()
    since = Rotation.from_matrix(poses[:, :3, :3]) * Rotation.from_matrix(poses[0, :3, :3]).inv()
    grown = Rotation.from_rotvec(since[:1].as_rotvec())
    for row in range(1, len(poses)):  # step by step: a rotation vector of more than half a turn has two
        step = (since[row] * since[row - 1].inv()).as_rotvec()
        grown = Rotation.concatenate((grown, Rotation.from_rotvec(1.04 * step) * grown[-1]))
    poses[:, :3, :3] = (grown * Rotation.from_matrix(filmed.world_from_cam[0, :3, :3])).as_matrix()
    capture = replace(filmed, world_from_cam=poses)
    found = by_depth(capture, find_matches(capture, motion_of(capture)))
    assert 0.93 <= found.turn <= 0.98
    assert found.turn_px.min() < found.given_px


# --- adjusted poses --------------------------------------------------------------------------------------------------


def test_exact_poses_hardly_move(filmed):
    found = adjust_poses(filmed)
    assert found.moved < 0.003
    assert found.turned_deg < 0.06
    assert found.turns == pytest.approx(1, abs=0.005)
    assert found.with_depth


@pytest.mark.parametrize("with_depth", [True, False])
def test_each_camera_has_a_focal_length_of_its_own(filmed, with_depth):
    """Every second frame's camera claims a focal length that is 3 % too long.

    Both together are less sure than their ratio: they trade off against turns.
    """
    camera = filmed.cameras["c"]
    longer = replace(camera, focal_px=tuple(1.03 * each for each in camera.focal_px))
    two = replace(filmed, cameras={"c": camera, "d": longer}, camera_of=("c", "d") * 20)
    found = adjust_poses(two if with_depth else replace(two, depth=None))
    print(found.focal, found.moved, found.turned_deg, found.turns)
    assert found.focal["d"] / found.focal["c"] == pytest.approx(1 / 1.03, abs=0.005)
    assert found.focal["c"] == pytest.approx(1, abs=0.012)
    few = adjust_poses(replace(two, camera_of=("c",) * 36 + ("d",) * 4, depth=None))
    assert few.focal == {}


def test_frames_between_move_with_their_neighbours(filmed, monkeypatch):
    """Every second frame is adjusted; the whole path was turned aside by a drift, which is taken back from all."""
    monkeypatch.setattr("mambaloc.importing.checks.adjusting._MAX_FRAMES", 20)
    rng, poses = np.random.default_rng(3), filmed.world_from_cam.copy()
    wave = np.sin(np.arange(40)[:, None] / 5 + rng.uniform(0, 6, 3))
    poses[:, :3, :3] = Rotation.from_rotvec(np.radians(0.6) * wave).as_matrix() @ poses[:, :3, :3]
    found = adjust_poses(replace(filmed, world_from_cam=poses))
    assert found.frames == 20

    def off_deg(world_from_cam):
        true = Rotation.from_matrix(filmed.world_from_cam[1::2, :3, :3])
        return np.degrees((true.inv() * Rotation.from_matrix(world_from_cam[1::2, :3, :3])).magnitude()).mean()

    assert off_deg(found.world_from_cam) < 0.7 * off_deg(poses)
