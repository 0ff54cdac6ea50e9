"""What the advisor proposes of paths whose best split is known, and what it says of them."""

from __future__ import annotations

import numpy as np
import pytest
from captures import capture_of, line, poses_at

from mambaloc.errors import InputError
from mambaloc.importing.motion import motion_of
from mambaloc.importing.splits.advisor import propose
from mambaloc.importing.splits.selection import KINDS, RULE, choose, distances, measured


def proposals_of(capture):
    found = propose(capture, motion_of(capture))
    assert [each.kind for each in found] == [kind for kind in KINDS if kind in {each.kind for each in found}]
    return {each.kind: each for each in found}


def laps(count, turns, spread=0.3):
    """A camera that walks around a room, looking ahead; each lap is a little wider than the last."""
    angle = np.linspace(0, 2 * np.pi * turns, count, endpoint=False)
    radius = 2 + spread * angle / (2 * np.pi)
    position = radius[:, None] * np.stack((np.cos(angle), np.sin(angle), np.zeros(count)), axis=1)
    return poses_at(position, np.degrees(angle) + 90)


def test_distances_by_hand():
    """Steps of 10 cm and 2 degrees: the nearest frame is that of the smaller of larger counts."""
    capture = capture_of(poses_at(line(30), 2.0 * np.arange(30)))
    length, turn_deg, steps = distances(capture, motion_of(capture), np.array([10, 11]), np.array([0, 7, 14]))
    np.testing.assert_allclose(length, [0.3, 0.3])
    np.testing.assert_allclose(turn_deg, [6, 6], atol=1e-6)
    np.testing.assert_allclose(steps, [3, 3])


def test_a_frame_at_the_same_place_that_looks_elsewhere_is_not_near():
    poses = poses_at(np.concatenate((line(20), line(20))), np.repeat([0.0, 90.0], 20))
    capture = capture_of(poses, sequences=("a",) * 20 + ("b",) * 20)
    _, turn_deg, steps = distances(capture, motion_of(capture), np.arange(20), np.arange(20, 40))
    np.testing.assert_allclose(turn_deg, 90)
    assert (steps > 100).all()


def test_one_straight_recording_is_split_by_blocks():
    capture = capture_of(poses_at(line(200)))
    found = proposals_of(capture)
    assert list(found) == ["block"]
    block = found["block"]
    assert block.counts["test"] == pytest.approx(40, abs=2)
    assert block.counts["val"] == pytest.approx(20, abs=2)
    assert block.is_leak_free
    assert block.is_covered
    test, train = (np.flatnonzero(block.split == split) for split in ("test", "train"))
    gaps = np.abs(test[:, None] - train).min(axis=1)
    assert gaps.min() == 5  # two in a hundred frames are left out on either side
    assert block.steps[1] == pytest.approx(np.median(gaps))
    assert choose(list(found.values()), "auto", capture).proposal is block


def test_validation_frames_are_as_far_from_training_as_test_frames():
    block = proposals_of(capture_of(poses_at(line(200))))["block"]
    val, train = (np.flatnonzero(block.split == split) for split in ("val", "train"))
    gaps = np.abs(val[:, None] - train).min(axis=1)
    assert gaps.min() > 2
    assert 0.4 < np.median(gaps) / block.steps[1] < 2.5


def test_a_path_that_comes_back_is_split_by_a_pass():
    capture = capture_of(laps(240, 2))
    found = proposals_of(capture)
    assert list(found) == ["loop", "block"]
    loop = found["loop"]
    test, train = (np.flatnonzero(loop.split == split) for split in ("test", "train"))
    assert (np.diff(test) == 1).all()
    angle = np.arange(240) * 3 % 360
    for row in test:  # the other pass sees it from as good as there
        assert np.abs((angle[train] - angle[row] + 180) % 360 - 180).min() <= 3
    assert np.abs(test[:, None] - train).min() > 2
    chosen = choose(list(found.values()), "auto", capture)
    assert chosen.proposal is loop
    assert not chosen.warning


@pytest.mark.parametrize("poses", [poses_at(line(240)), laps(240, 0.9)], ids=["straight", "an open circle"])
def test_a_path_that_does_not_come_back_has_no_loop(poses):
    capture = capture_of(poses)
    found = proposals_of(capture)
    assert "loop" not in found
    with pytest.raises(
        InputError, match="--split loop: this capture has no path that comes back; choose one of auto, block"
    ):
        choose(list(found.values()), "loop", capture)


def test_a_way_back_that_looks_the_other_way_is_no_loop():
    there = line(100)
    poses = poses_at(np.concatenate((there, there[::-1] + np.array((0, 0.1, 0)))), np.repeat([0.0, 180.0], 100))
    assert "loop" not in proposals_of(capture_of(poses))


def test_recordings_are_split_whole():
    passes = [line(50) + np.array((0, 0.35 * number, 0)) for number in range(5)]
    names = tuple(np.repeat(["a", "b", "c", "d", "e"], 50).tolist())
    capture = capture_of(poses_at(np.concatenate(passes)), sequences=names)
    found = proposals_of(capture)
    split = found["sequence"].split
    tested = {name for name, part in zip(names, split, strict=True) if part == "test"}
    assert len(tested) == 1
    assert all(part == "test" for name, part in zip(names, split, strict=True) if name in tested)
    assert choose(list(found.values()), "auto", capture).proposal.kind == "sequence"


def test_a_given_split_of_every_eighth_frame_leaks_and_is_taken_with_a_warning():
    given = tuple("test" if row % 8 == 0 else "train" for row in range(160))
    capture = capture_of(poses_at(line(160)), split=given)
    found = proposals_of(capture)
    assert found["given"].near > 0.8
    assert not found["given"].is_leak_free
    assert found["given"].steps[1] == pytest.approx(1)
    for asked in ("auto", "given"):
        chosen = choose(list(found.values()), asked, capture)
        assert chosen.proposal.kind == "given"
        assert "of test frames are within 2 steps" in chosen.warning
    assert choose([each for each in found.values() if each.kind != "given"], "auto", capture).proposal.kind == "block"


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({}, "this capture has no split of its own;"),
        ({"split_concern": "lists of names"}, "this capture has lists of names;"),
        ({"split": ("train",) * 60}, "a split of its own with 60 train frames and 0 test frames whose poses and"),
    ],
)
def test_a_given_split_that_is_none_is_refused_with_its_reason(given, says):
    capture = capture_of(poses_at(line(60)), **given)
    proposals = list(proposals_of(capture).values())
    with pytest.raises(InputError, match=f"--split given: .*{says}"):
        choose(proposals, "given", capture)
    assert choose(proposals, "auto", capture).warning.startswith("the capture has lists") == ("split_concern" in given)


def test_a_given_split_keeps_its_validation_frames():
    given = ("train",) * 80 + ("unused",) * 4 + ("val",) * 16 + ("unused",) * 4 + ("test",) * 20
    found = proposals_of(capture_of(poses_at(line(124)), split=given))
    assert tuple(found["given"].split.tolist()) == given


def test_a_split_out_of_reach_is_told():
    capture = capture_of(poses_at(line(100)))
    split = np.array(["train"] * 20 + ["unused"] * 60 + ["test"] * 20)
    proposal = measured("block", "by hand", split, capture, motion_of(capture))
    assert proposal.is_leak_free
    assert not proposal.is_covered
    chosen = choose([proposal], "auto", capture)
    assert "asks much" in chosen.warning
    assert "none is both" in chosen.why


def test_frames_in_no_order_are_split_by_place():
    order = np.random.default_rng(3).permutation(120)
    position = np.stack((np.linspace(0, 10, 120), np.tile([0.0, 0.5, 1.0], 40), np.zeros(120)), axis=1)[order]
    found = proposals_of(capture_of(poses_at(position)))
    assert list(found) == ["block"]
    tested = position[found["block"].split == "test", 0]
    trained = position[found["block"].split == "train", 0]
    assert np.abs(tested[:, None] - trained).min() > 0.1


@pytest.mark.parametrize("count", [20, 27, 50, 1000])
def test_every_count_of_frames_can_be_split(count):
    counts = proposals_of(capture_of(laps(count, 1)))["block"].counts
    assert sum(counts.values()) == count
    assert counts["train"] >= 0.25 * count
    assert min(counts["val"], counts["test"]) >= 2


def test_the_rule_says_its_numbers():
    assert "at most 10% of its test frames are near, within 2 steps" in RULE
    assert "A given split is taken, whatever it measures." in RULE
    assert "in the order sequence, loop, block" in RULE
