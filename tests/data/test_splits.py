"""What is held out and what is kept: properties that hold for every scene, and the edges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mambaloc.data.frames import Frames
from mambaloc.data.splits import clips_of, hold_out, subsample
from mambaloc.errors import InputError

briefly = settings(max_examples=60, deadline=None)

# Lists of frames by sequence: one after the other as recorded, or mixed as a list file may have them.
one_after_the_other = st.lists(st.integers(1, 60), min_size=1, max_size=6).map(
    lambda lengths: [f"seq-{i:02d}" for i, length in enumerate(lengths) for _ in range(length)]
)
mixed = st.lists(st.sampled_from(["a", "b", "c", "d"]), min_size=1, max_size=80)
fractions = st.floats(0.01, 0.99)


def frames_of(names: list[str]) -> Frames:
    paths = tuple(Path(name) / f"{i}.png" for i, name in enumerate(names))
    return Frames(paths, tuple(names), np.zeros((len(names), 3)), np.zeros((len(names), 4)))


def rows_of(names: list[str]) -> dict[str, list[int]]:
    return {name: [i for i, other in enumerate(names) if other == name] for name in dict.fromkeys(names)}


def try_hold_out(names: list[str], *args, **kwargs) -> tuple[list[int], list[int]] | None:
    try:
        train, val = hold_out(frames_of(names), *args, **kwargs)
    except InputError:
        return None
    return train.tolist(), val.tolist()


@briefly
@given(one_after_the_other | mixed, fractions)
def test_whole_sequences_from_the_last_are_held_out_until_the_fraction_is_reached(names, fraction):
    rows, split = rows_of(names), try_hold_out(names, "sequences", fraction)
    held_out = []
    for name in list(rows)[::-1]:  # as few as do
        if held_out and sum(len(rows[n]) for n in held_out) >= round(fraction * len(names)):
            break
        held_out.insert(0, name)
    if len(held_out) == len(rows):
        assert split is None
        return
    assert split == (
        [i for name in rows if name not in held_out for i in rows[name]],
        [i for name in held_out for i in rows[name]],
    )


@briefly
@given(one_after_the_other | mixed, fractions, st.integers(0, 30))
def test_a_block_is_each_sequences_end_behind_a_gap(names, fraction, gap):
    split = try_hold_out(names, "block", fraction, gap)
    assume(split is not None)
    train, val = split
    assert train
    assert val
    assert not set(train) & set(val)
    for rows in rows_of(names).values():
        kept, held_out = [i for i in train if i in rows], [i for i in val if i in rows]
        assert held_out == rows[-max(1, round(fraction * len(rows))) :]
        dropped = len(rows) - len(kept) - len(held_out)
        assert kept == rows[: len(kept)]  # in order
        assert dropped == gap or (not kept and dropped <= gap)


@briefly
@given(st.integers(1, 60), fractions, st.integers(0, 30))
def test_a_block_is_refused_only_where_nothing_is_left_to_train_on(length, fraction, gap):
    is_refused = try_hold_out(["seq-01"] * length, "block", fraction, gap) is None
    assert is_refused == (length - max(1, round(fraction * length)) - gap <= 0)


@briefly
@given(one_after_the_other | mixed, fractions, st.integers(0, 30))
def test_auto_takes_sequences_where_there_are_several_and_a_block_of_one(names, fraction, gap):
    by = "block" if len(set(names)) == 1 else "sequences"
    assert try_hold_out(names, "auto", fraction, gap) == try_hold_out(names, by, fraction, gap)


def test_a_single_sequence_gives_a_block():
    train, val = hold_out(frames_of(["seq-02"] * 1000))
    assert train.tolist() == list(range(880))
    assert val.tolist() == list(range(900, 1000))


@pytest.mark.parametrize("validation", ["auto", "sequences"])
def test_sequences_are_held_out_by_name(validation):
    names = ["a"] * 3 + ["b"] * 2 + ["c"] * 4
    train, val = hold_out(frames_of(names), validation, sequences=["c", "a"])
    assert train.tolist() == [3, 4]
    assert val.tolist() == [0, 1, 2, 5, 6, 7, 8]


def test_blocks_are_the_ends_of_named_sequences_only():
    names = ["a"] * 6 + ["b"] * 6 + ["c"] * 3
    train, val = hold_out(frames_of(names), "block", fraction=1 / 3, gap=1, sequences=["b", "c"])
    assert train.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8, 12]
    assert val.tolist() == [10, 11, 14]


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        ("aabb", {"sequences": ["x"]}, "data.val_sequences: no x in the training split; it has a, b"),
        ("aabb", {"sequences": ["a", "b"]}, "leaves none to train on"),
        ("aaaa", {"validation": "sequences"}, "leaves none to train on"),
        ("aabb", {"fraction": 0.9}, "leaves none to train on"),
        ("a" * 25, {"fraction": 0.5}, "leave 0 frames to train and 12 to validate on, of 25"),
        ("a", {"gap": 0}, "leave 0 frames to train and 1 to validate on, of 1"),
        ("aabb", {"fraction": 0.0}, "data.val_fraction 0.0: must lie between 0 and 1"),
        ("aabb", {"fraction": 1.0}, "data.val_fraction 1.0: must lie between 0 and 1"),
        ("aabb", {"fraction": float("nan")}, "data.val_fraction nan: must lie between 0 and 1"),
        ("aaaa", {"fraction": 1.5, "gap": 0}, "data.val_fraction 1.5: must lie between 0 and 1"),
        ("aaaa", {"fraction": -0.5, "gap": 0}, "data.val_fraction -0.5: must lie between 0 and 1"),
        ("aaaa", {"gap": -1}, "data.val_gap -1: must be 0 or more"),
    ],
)
def test_what_cannot_be_held_out_is_refused(names, options, message):
    with pytest.raises(InputError) as caught:
        hold_out(frames_of(list(names)), **options)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@briefly
@given(one_after_the_other | mixed, st.integers(1, 25))
def test_every_kth_frame_of_each_sequence_is_kept(names, keep_every):
    kept = subsample(frames_of(names), keep_every).tolist()
    assert kept == [i for rows in rows_of(names).values() for n, i in enumerate(rows) if n % keep_every == 0]


@briefly
@given(one_after_the_other, st.data())
def test_a_count_is_kept_exactly_and_evenly(names, data):
    count = data.draw(st.integers(1, len(names)))
    kept = subsample(frames_of(names), keep_count=count)
    assert len(kept) == count
    assert kept[0] >= 0
    assert kept[-1] < len(names)
    steps = np.diff([*kept, len(names) + kept[0]])  # laid end to end, round to the start
    assert set(steps) <= {len(names) // count, -(-len(names) // count)}


def test_a_twentieth_of_heads_is_fifty_frames():
    heads = frames_of(["seq-02"] * 1000)
    assert subsample(heads, keep_every=20).tolist() == list(range(0, 1000, 20))
    assert subsample(heads, keep_count=50).tolist() == list(range(0, 1000, 20))
    assert subsample(heads).tolist() == list(range(1000))


@pytest.mark.parametrize("options", [{"keep_every": 0}, {"keep_every": -2}, {"keep_count": 0}, {"keep_count": 11}])
def test_subsampling_out_of_range_is_refused(options):
    ((name, value),) = options.items()
    with pytest.raises(InputError, match=f"data.{name} {value}: "):
        subsample(frames_of(["a"] * 10), **options)


# --- clips -----------------------------------------------------------------------------------------------------------


def test_clips_hold_their_frame_and_never_cross_a_border():
    names = ["a"] * 30 + ["b"] * 25
    clips = clips_of(frames_of(names), length=3, skip=10)
    assert clips.shape == (55, 3)
    assert (np.array(names)[clips] == np.array(names)[clips[:, :1]]).all()
    assert (clips == np.arange(55)[:, None]).any(axis=1).all()
    assert (np.diff(clips, axis=1) > 0).all()


def test_clips_by_hand():
    clips = clips_of(frames_of(["a"] * 25), length=3, skip=10)
    assert clips[12].tolist() == [2, 12, 22]  # the middle fits
    assert clips[3].tolist() == [3, 13, 23]  # no room before: the first
    assert clips[22].tolist() == [2, 12, 22]  # none after: the last
    assert clips_of(frames_of(["a"] * 4), length=3, skip=10).tolist() == [[0, 1, 2], [0, 1, 2], [1, 2, 3], [1, 2, 3]]


def test_sequences_shorter_than_a_clip_have_none():
    assert clips_of(frames_of(["a", "b", "b", "b"]), length=3, skip=1).tolist() == [[1, 2, 3]] * 3


@pytest.mark.parametrize(
    ("length", "skip", "message"),
    [(3, 1, "longest of 2 training sequences has 2 frames"), (1, 1, "clip_length 1"), (2, 0, "clip_skip 0")],
)
def test_clips_that_cannot_be(length, skip, message):
    with pytest.raises(InputError, match=message):
        clips_of(frames_of("aabb"), length, skip)
