"""Transforms at a time: against SciPy's slerp, through chains of frames, and what is not known."""

from __future__ import annotations

import numpy as np
import pytest
from bag_writing import FIRST_NS, recorder
from scipy.spatial.transform import Rotation, Slerp

from mambaloc.bags.reading import open_bag
from mambaloc.bags.transforms import Gap, Transforms, along
from mambaloc.errors import InputError

STEP_NS = 20_000_001


def poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, :3, :3] = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.3, (count, 3)), axis=0)).as_matrix()
    matrices[:, :3, 3] = np.cumsum(rng.normal(0, 0.1, (count, 3)), axis=0)
    return matrices


def interpolated(times: np.ndarray, matrices: np.ndarray, at: int) -> np.ndarray:
    """SciPy's: positions by line, rotations by slerp; times as whole nanoseconds since the first."""
    since, when = (times - times[0]).astype(float), float(at - times[0])
    matrix = np.eye(4)
    matrix[:3, :3] = Slerp(since, Rotation.from_matrix(matrices[:, :3, :3]))(when).as_matrix()
    matrix[:3, 3] = [np.interp(when, since, matrices[:, axis, 3]) for axis in range(3)]
    return matrix


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """``map -> odom -> base`` moves, ``base -> mast -> eye`` does not, and ``base -> arm`` stops for two seconds."""
    path, times = tmp_path_factory.mktemp("robot") / "drive", FIRST_NS + STEP_NS * np.arange(30)
    moving, still, slow = poses(30), poses(3, seed=1), poses(30, seed=2)
    with recorder(path, "mcap") as bag:
        bag.transform(0, "base", "mast", still[0], "/tf_static")
        bag.transform(0, "mast", "eye", still[1], "/tf_static")
        for row in np.random.default_rng(3).permutation(30).tolist():  # not in order
            bag.transform(int(times[row]), "odom", "base", moving[row])
            bag.transform(int(times[row]) + 7, "map", "odom", slow[row])
            bag.transform(int(times[row]) + (row > 14) * 2 * 10**9, "base", "arm", slow[row])
        bag.transform(0, "island", "tree", still[2], "/tf_static")
        bag.transform(0, "left", "shared", still[2], "/tf_static")
        bag.transform(0, "right", "shared", still[2], "/tf_static")
        bag.transform(0, "hen", "egg", still[2])
        bag.transform(0, "egg", "hen", still[2])
    with open_bag(path) as bag:
        return Transforms(bag), times, moving, slow, still


def test_a_link_is_interpolated(robot):
    transforms, times, moving, *_ = robot
    path = transforms.path("odom", "base")
    for at in (times[0], times[3], times[3] + 1, times[3] + STEP_NS // 3, times[-1] - 1, times[-1]):
        np.testing.assert_allclose(along(path, int(at)), interpolated(times, moving, at), atol=1e-12)


def test_a_chain_is_the_product_of_links_at_that_time(robot):
    transforms, times, moving, slow, still = robot
    at = int(times[7]) + 12_345
    expected = interpolated(times + 7, slow, at) @ interpolated(times, moving, at) @ still[0] @ still[1]
    np.testing.assert_allclose(along(transforms.path("map", "eye"), at), expected, atol=1e-12)
    assert transforms.root("eye") == "map"
    sideways = np.linalg.inv(still[0] @ still[1]) @ interpolated(np.delete(times, range(15, 30)), slow[:15], at)
    np.testing.assert_allclose(along(transforms.path("eye", "arm"), at), sideways, atol=1e-12)


def test_links_above_the_common_frame_are_not_needed(robot):
    transforms, *_ = robot
    np.testing.assert_allclose(along(transforms.path("base", "eye"), 5), robot[4][0] @ robot[4][1], atol=1e-12)


def test_gaps_are_named(robot):
    transforms, times, *_ = robot
    odom, arm = transforms.path("odom", "base"), transforms.path("base", "arm")
    for at in (times[0] - 1, times[-1] + 1):
        gap = along(odom, int(at))
        assert isinstance(gap, Gap)
        assert (gap.link.child, gap.length_s) == ("base", None)
    gap = along(arm, int(times[14]) + 10**9)
    assert isinstance(gap, Gap)
    assert gap.length_s == pytest.approx(2.0 + STEP_NS / 1e9)


@pytest.mark.parametrize(
    ("parent", "child", "says"),
    [
        ("map", "tree", "no transform links the frames 'map' and 'tree'; /tf and /tf_static have arm, base"),
        ("map", "nowhere", "'map' and 'nowhere'"),
        ("left", "shared", "frame 'shared' has the parents 'left' and 'right'"),
        ("map", "hen", "is above itself in /tf"),
    ],
)
def test_what_links_nothing_is_refused(robot, parent, child, says):
    with pytest.raises(InputError) as caught:
        robot[0].path(parent, child)
    assert says in str(caught.value)
    assert "drive: " in str(caught.value)


def test_marks_of_no_fix_are_gaps(tmp_path):
    """Trackers that are lost send NaN or a rotation of zeros: neighbours are interpolated over them."""
    matrices, times = poses(3), FIRST_NS + STEP_NS * np.arange(3)
    with recorder(tmp_path / "a.bag", "bag") as bag:
        bag.transform(int(times[0]), "/map", "/eye", matrices[0])
        lost = matrices[1].copy()
        lost[0, 3] = np.nan
        bag.transform(int(times[1]), "/map", "/eye", lost)
        bag.transform(int(times[2]), "/map", "/eye", matrices[2])
    with open_bag(tmp_path / "a.bag") as bag:
        transforms = Transforms(bag)
    kept = interpolated(times[[0, 2]], matrices[[0, 2]], times[1])
    np.testing.assert_allclose(along(transforms.path("map", "eye"), int(times[1])), kept, atol=1e-12)
